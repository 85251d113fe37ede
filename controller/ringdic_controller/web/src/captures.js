// The capture buttons, and the list of captures with the outcome of every camera.

import { patch, post, url } from "./api.js";
import { byId, clockTime, element, notice } from "./dom.js";
import { state } from "./live.js";

const KINDS = ["board", "target", "specimen", "static"];
const HINTS = { static: "Capture the specimen at rest with every camera, to measure the noise floor" };

// The buttons ------------------------------------------------------------------------------------

/** The sentence that says why no capture can begin now, or null. */
function refusal() {
  if (!state.connected) return "The controller does not answer.";
  if (!state.rig) return "Waiting for the controller.";
  if (state.rig.refusal) return state.rig.refusal;
  const missing = state.rig.missing;
  if (missing.length && !byId("override").checked) {
    return missing.length === 1
      ? `Camera ${missing[0]} is not connected: start its node, or tick the box to capture without it.`
      : `Cameras ${missing.join(", ")} are not connected: start their nodes, or tick the box to capture without them.`;
  }
  return null;
}

function roundSentence(round) {
  if (!round || round.session !== state.current) return "";
  if (round.state === "arming") return `Arming the cameras for a ${round.kind} capture …`;
  if (round.state === "open") return `Collecting ${round.capture_id} …`;
  if (round.state === "refused") return round.error;
  return `${round.capture_id} has closed.`;
}

export function showCapture() {
  const why = refusal();
  for (const kind of KINDS) {
    const button = byId(`capture-${kind}`);
    button.disabled = Boolean(why);
    button.title = why ?? HINTS[kind] ?? `Capture the ${kind} with every camera`;
  }
  const running = state.round && ["arming", "open"].includes(state.round.state);
  const sentence = (running ? roundSentence(state.round) : why) || roundSentence(state.round);
  const status = byId("capture-status");
  status.textContent = sentence;
  status.classList.toggle("bad", !running && (Boolean(why) || state.round?.state === "refused"));
}

async function capture(kind) {
  try {
    notice("");
    const round = await post(url("captures"), { kind, override: byId("override").checked });
    if (state.round?.id !== round.id) state.round = round; // else an event has brought a newer state already
  } catch (error) {
    notice(error.message);
  }
  showCapture();
}

// The list ---------------------------------------------------------------------------------------

const imageUrl = (record, camera) => url("sessions", state.current, "captures", record.capture_id, "images", camera);

function openPicture(record, camera) {
  byId("picture-title").textContent = `${record.capture_id}, camera ${camera}`;
  const image = byId("picture-image");
  image.src = `${imageUrl(record, camera)}/preview?width=1200`;
  image.alt = `Image of camera ${camera}`;
  byId("picture-original").href = imageUrl(record, camera);
  byId("picture").showModal();
}

function skewText(record) {
  if (record.skew_ns === null || record.skew_ns === undefined) return "";
  const us = record.skew_ns / 1000;
  const parts = [us < 1000 ? `skew ${us.toFixed(0)} µs` : `skew ${(us / 1000).toFixed(2)} ms`];
  if (Number.isFinite(record.skew_error_ns)) parts[0] += ` ± ${(record.skew_error_ns / 1e6).toFixed(2)} ms`;
  if (record.skew_exceeded) parts.push("beyond the tolerance");
  if (record.readout_ns) parts.push(`rows read over ${(record.readout_ns / 1e6).toFixed(1)} ms`);
  return parts.join(", ");
}

const word = (status) => status.replace("-", " ");

function exposedLate(record, entry) {
  if (!entry.time_ns || !record.fire_at_ns || !record.tolerance_ns) return null;
  const late = entry.time_ns - record.fire_at_ns;
  if (Math.abs(late) <= record.tolerance_ns) return null;
  return `exposed ${Math.abs(late / 1e6).toFixed(1)} ms ${late > 0 ? "late" : "early"}`;
}

function countText(cameras) {
  const counts = Object.entries(Object.groupBy(cameras, ([, entry]) => entry.status));
  return counts.map(([status, entries]) => `${entries.length} ${word(status)}`).join(", ");
}

function cameraCell(record, [id, entry]) {
  const picture = entry.file
    ? element(
        "button",
        { class: "thumb", type: "button", "aria-label": `Show camera ${id}`, onclick: () => openPicture(record, id) },
        element("img", { loading: "lazy", alt: "", src: `${imageUrl(record, id)}/preview?width=160` }),
      )
    : element("span", { class: "thumb none" }, "no image");
  const notes = [entry.reason, exposedLate(record, entry)].filter(Boolean);
  return element(
    "li",
    { class: `camera ${entry.status}`, title: notes.join("\n") },
    picture,
    element("span", {}, `${id} `, element("b", {}, word(entry.status))),
    ...notes.map((note) => element("small", {}, note)),
  );
}

/** The note of a capture: stored when the field is left, or with Enter. */
function noteField(record) {
  const address = url("sessions", state.current, "captures", record.capture_id);
  const store = async (event) => {
    try {
      notice("");
      await patch(address, { note: event.target.value });
    } catch (error) {
      notice(error.message);
    }
  };
  const attributes = { type: "text", maxlength: "2000", value: record.note ?? "", onchange: store };
  return element("label", { class: "note" }, "Note ", element("input", attributes));
}

function captureItem(record, open) {
  const cameras = Object.entries(record.cameras);
  const dots = cameras.map(([id, { status, reason }]) =>
    element("i", { class: `dot ${status}`, title: `${id}: ${word(status)}${reason ? `, ${reason}` : ""}` }),
  );
  const skew = skewText(record);
  const box = element(
    "details",
    { open },
    element(
      "summary",
      {},
      element("span", { class: "capture-name" }, record.capture_id),
      element("span", { class: "dots" }, ...dots),
      element("span", { class: "capture-count" }, record.state === "open" ? "open" : countText(cameras)),
      element("span", { class: record.skew_exceeded ? "bad" : "muted" }, skew),
      element("time", { class: "muted", datetime: record.opened_at }, clockTime(record.opened_at)),
      record.override ? element("span", { class: "tag" }, "override") : null,
      record.note ? element("span", { class: "muted" }, record.note) : null,
    ),
  );
  const fill = () => {
    if (box.open && box.children.length === 1) {
      box.append(noteField(record));
      box.append(element("ol", { class: "cameras" }, ...cameras.map((camera) => cameraCell(record, camera))));
    }
  };
  box.addEventListener("toggle", fill);
  fill();
  return element("li", { "data-capture": record.capture_id, "data-state": record.state }, box);
}

const shown = new Map(); // capture id -> { text, item }

export function showCaptures() {
  byId("captures-count").textContent = state.captures.length ? `${state.captures.length}` : "";
  const items = [...state.captures].reverse().map((record) => {
    const text = JSON.stringify([state.current, record]);
    const before = shown.get(record.capture_id);
    if (before?.text === text) return before.item;
    const item = captureItem(record, before?.item.firstChild.open ?? false);
    shown.set(record.capture_id, { text, item });
    return item;
  });
  const list = byId("captures");
  if (!items.length) {
    list.replaceChildren(element("li", { class: "muted" }, "No captures in this session yet."));
  } else if (items.length !== list.children.length || items.some((item, i) => item !== list.children[i])) {
    list.replaceChildren(...items);
  }
}

export function wireCaptures() {
  for (const kind of KINDS) byId(`capture-${kind}`).addEventListener("click", () => capture(kind));
  byId("override").addEventListener("change", showCapture);
  byId("picture-close").addEventListener("click", () => byId("picture").close());
}
