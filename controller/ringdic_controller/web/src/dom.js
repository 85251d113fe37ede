// Short forms for elements of the page and for numbers as text.

export const byId = (id) => document.getElementById(id);

/** An element: element("li", { class: "node", title: "…" }, child, "text", …). Absent attributes: null, false. */
export function element(tag, attributes = {}, ...children) {
  const item = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "style") item.style.cssText = value; // as an attribute, the page's content security policy refuses it
    else if (name.startsWith("on")) item.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false && value !== undefined) item.setAttribute(name, value === true ? "" : value);
  }
  item.append(...children.filter((child) => child !== null && child !== undefined));
  return item;
}

/** Make the options of a select, keeping what was chosen where it is still there. */
export function setOptions(select, options, chosen = select.value) {
  const wanted = JSON.stringify(options);
  if (select.dataset.options !== wanted) {
    select.dataset.options = wanted;
    const groups = new Map();
    for (const { value, label, group = "" } of options) {
      if (!groups.has(group)) groups.set(group, []);
      groups.get(group).push(element("option", { value }, label));
    }
    select.replaceChildren(
      ...[...groups].flatMap(([group, items]) => (group ? [element("optgroup", { label: group }, ...items)] : items)),
    );
  }
  if (options.some((option) => option.value === chosen)) select.value = chosen;
}

let noticeTimer;

/** Show a sentence at the top of the page for 15 s; an empty one removes it. */
export function notice(sentence) {
  const box = byId("notice");
  box.textContent = sentence;
  box.hidden = !sentence;
  clearTimeout(noticeTimer);
  if (sentence) noticeTimer = setTimeout(() => notice(""), 15000);
}

export const duration = (seconds) => {
  if (seconds === null || seconds === undefined) return "";
  const whole = Math.round(seconds);
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${whole % 60} s`;
};

/** "1 capture", "12 captures". */
export const counted = (number, noun) => `${number.toLocaleString()} ${noun}${number === 1 ? "" : "s"}`;

export const clockTime = (iso) => (iso ? new Date(iso).toLocaleTimeString([], { hour12: false }) : "");

/** A number as text with a given number of significant digits. */
export function figure(value, digits = 4) {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-4) return value.toExponential(digits - 2);
  return Number(value.toPrecision(digits)).toString();
}
