// The results of a run or of the newest step: what is followed or chosen, field and step, limits, legend, figures.

import { get, getBytes, url } from "./api.js";
import { SCALES, cssGradient, ticks } from "./colours.js";
import { byId, counted, element, figure, notice, setOptions } from "./dom.js";
import { noteDrawn } from "./following.js";
import { state } from "./live.js";

const LIVE = "live"; // the choice in place of a run
const FIRST_FIELD = "lambda2";
const PLAY_EVERY = 900; // ms

let viewer = null; // promise of the viewer, loaded when there is something to see
let surface = null;
let header = null; // of the chosen run
let facesOf = null; // the header whose triangles the viewer has
let newestShown = null;
let limitsSoFar = new Map(); // session/field/removed -> [low, high] of all live steps shown
let limitsByHand = null; // [low, high] typed by the operator for the present field
let playing = null;
let viewedSession = null; // the session that the view was made for
let shownPoints = null; // the positions that the viewer has
let opening = 0; // number of the newest request to open results
let wanted = 0; // number of the newest request to show a step: older requests give up when their arrays arrive
const arrays = new Map(); // address -> promise of an ArrayBuffer

const chosenField = () => header.fields.find((field) => field.name === byId("field").value) ?? header.fields[0];
const removed = () => byId("rigid").checked;

const shortTime = (iso) =>
  new Date(iso).toLocaleString([], { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", hour12: false });

// Loading ----------------------------------------------------------------------------------------

const own = (...parts) => url("sessions", header.session, ...header.place, ...parts);

function bytes(...parts) {
  const address = `${own(...parts)}?v=${header.version}&rigid_motion_removed=${removed()}`;
  if (!arrays.has(address)) {
    const loading = getBytes(address);
    loading.catch(() => arrays.delete(address));
    arrays.set(address, loading);
    if (arrays.size > 120) arrays.delete(arrays.keys().next().value);
  }
  return arrays.get(address);
}

const following = () => byId("follow").checked;

/** The newest result of the present session, a live step or a run: the choice that shows it, and its name. */
function newest() {
  const [run, step] = [state.runs.at(-1), state.newest];
  if (step && (!run || Date.parse(step.ready_at) > Date.parse(run.finished_at) + 999)) {
    return { choice: LIVE, name: `${state.current}/${step.capture_id}/${step.ready_at}` };
  }
  return run ? { choice: run.run, name: `${state.current}/${run.run}/${run.finished_at}` } : null;
}

/** Offer the results of the present session; while the switch "Live" is on, a new one is shown at once. */
export async function showNewest() {
  const latest = newest();
  byId("results-empty").hidden = latest !== null;
  byId("results").hidden = byId("follow-line").hidden = latest === null;
  const runs = [...state.runs].reverse().map(({ run, finished_at }) => ({ value: run, label: `${run}, ${shortTime(finished_at)}` }));
  const live = state.newest ? [{ value: LIVE, label: `live, ${state.newest.capture_id}` }] : [];
  setOptions(byId("run"), [...live, ...runs]);
  if (!latest) {
    opening++;
    header = null;
    newestShown = null;
    stop();
    return;
  }
  if (latest.name === newestShown) return;
  const first = newestShown?.split("/")[0] !== state.current;
  newestShown = latest.name;
  if (!first && !following()) return;
  byId("run").value = latest.choice;
  await attempt(() => openChosen(true));
}

/** Load the chosen results. While the newest is followed, limits only widen; the view and the field always stay. */
async function openChosen(followed = false) {
  stop();
  arrays.clear();
  const request = ++opening;
  const choice = byId("run").value;
  const place = choice === LIVE ? ["live", state.newest.capture_id] : ["results", choice];
  const opened = { ...(await get(url("sessions", state.current, ...place))), place, followed: followed && choice === LIVE };
  if (request !== opening) return;
  const before = byId("field").value;
  if (!followed || header?.session !== opened.session) limitsByHand = null;
  header = opened;
  viewer ??= import("./surface.js").then(({ Surface }) => {
    surface = new Surface(byId("surface"), drawAxes);
    wirePicking();
  });
  const options = header.fields.map(({ name, label, unit, group }) => ({
    value: name,
    label: unit ? `${label} (${unit})` : label,
    group,
  }));
  setOptions(byId("field"), options, options.some(({ value }) => value === before) ? before : FIRST_FIELD);
  byId("step").max = String(header.steps.length - 1);
  byId("step").value = String(header.steps.length - 1);
  byId("report").hidden = choice === LIVE;
  byId("report").href = own("report");
  byId("download").href = own("file");
  const last = header.steps.length - 1;
  const [faces] = await Promise.all([
    bytes("faces"),
    bytes("positions", last),
    bytes("fields", chosenField().name, last),
    viewer,
  ]);
  if (request !== opening) return; // another was chosen meanwhile
  surface.setFaces(new Uint32Array(faces));
  facesOf = opened;
  shownPoints = null;
  showVerdict();
  showFigures();
  showUnmeasured();
  await show();
}

/** Load what the controls ask for and draw it, unless something else was asked for meanwhile. A session's first
 * drawing sets the view. */
async function show() {
  const field = chosenField();
  const step = Number(byId("step").value);
  const request = ++wanted;
  const [points, values] = await Promise.all([bytes("positions", step), bytes("fields", field.name, step)]);
  if (request !== wanted || facesOf !== header) return;
  const scale = SCALES[field.centre === null ? "sequential" : "diverging"];
  const [low, high] = limitsByHand ?? (header.followed ? widened(field) : automaticLimits(field));
  if (points !== shownPoints) surface.setPositions(new Float32Array(points));
  shownPoints = points;
  surface.setField(new Float32Array(values), field.location, scale, low, high);
  if (viewedSession !== header.session) {
    viewedSession = header.session;
    surface.resetView();
  }
  showLegend(field, scale, low, high);
  const name = step === 0 ? `${header.steps[0]} (reference)` : header.steps[step];
  byId("step-name").textContent = `${step} of ${header.steps.length - 1}: ${name}`;
  byId("step").setAttribute("aria-valuetext", name);
  byId("rigid").title = field.rigid ? "" : "The values of this field do not depend on it; the drawn shape does.";
  byId("surface").dataset.shown = `${field.name}/${step}/${removed()}`;
  byId("surface").dataset.of = header.place.join("/");
  if (header.capture_id) noteDrawn(header);
}

// Colours ----------------------------------------------------------------------------------------

/** Limits over all steps; symmetric about the centre where the field has one. */
function automaticLimits(field) {
  const range = (removed() && field.range_without_rigid_motion) || field.range || [0, 1];
  let [low, high] = range.map((value) => value ?? 0);
  if (field.centre !== null) {
    const reach = Math.max(Math.abs(low - field.centre), Math.abs(high - field.centre), 1e-6);
    [low, high] = [field.centre - reach, field.centre + reach];
  }
  return high > low ? [low, high] : [low - 0.5, low + 0.5];
}

/** Limits of all live steps of the session so far: a scale that jumped from step to step could not be compared. */
function widened(field) {
  const name = `${header.session}/${field.name}/${removed()}`;
  const [low, high] = automaticLimits(field);
  if (header.steps.length < 2) return [low, high];
  const [lowest, highest] = limitsSoFar.get(name) ?? [low, high];
  limitsSoFar.set(name, [Math.min(low, lowest), Math.max(high, highest)]);
  return limitsSoFar.get(name);
}

function showLegend(field, scale, low, high) {
  const labels = ticks(low, high).map((value) =>
    element("span", { class: "tick", style: `bottom: ${(100 * (value - low)) / (high - low)}%` }, figure(value)),
  );
  byId("legend").replaceChildren(
    element("p", { class: "legend-title" }, field.label, field.unit ? ` (${field.unit})` : ""),
    element(
      "div",
      { class: "legend-body" },
      element("div", { class: "ramp", style: `background: ${cssGradient(scale)}` }),
      element("div", { class: "ticks" }, ...labels),
    ),
    element("p", { class: "legend-none" }, element("i", {}), "not measured"),
  );
  for (const [id, value] of [["low", low], ["high", high]]) {
    if (document.activeElement !== byId(id)) byId(id).value = figure(value);
  }
}

function typedLimits() {
  const [low, high] = [byId("low").valueAsNumber, byId("high").valueAsNumber];
  if (Number.isFinite(low) && Number.isFinite(high) && high > low) {
    limitsByHand = [low, high];
    notice("");
  } else {
    notice("The limits of the colours must be two numbers, the first smaller than the second.");
  }
}

// Figures, picking, playing ----------------------------------------------------------------------

function showFigures() {
  const { points, faces, pairs, cameras } = header;
  byId("figures").textContent =
    [counted(points, "point"), counted(faces, "triangle"), counted(cameras.length, "camera"), counted(pairs.length, "pair")].join(", ");
  const rows = header.summary?.table?.filter((row) => !(row.figure in MARKS || row.figure === "verdict"));
  if (!Array.isArray(rows) || !rows.length) {
    byId("table").replaceChildren();
    return;
  }
  const names = Object.keys(rows[0]);
  const cells = (row) => names.map((name) => element("td", {}, String(row[name] ?? "")));
  // Rows of figures read as numbers only if every column but the first is one.
  const numeric = rows.every((row) => names.slice(1).every((name) => /^[-−–\d.,e+\s%]*$/.test(String(row[name] ?? ""))));
  byId("table").replaceChildren(
    element(
      "table",
      { class: numeric ? "numbers" : null },
      element("thead", {}, element("tr", {}, ...names.map((name) => element("th", { scope: "col" }, name)))),
      element("tbody", {}, ...rows.map((row) => element("tr", {}, ...cells(row)))),
    ),
  );
}

const MARKS = { sound: "✓", "look at this": "!", "do not use": "✕" };

/** Whether the results can be used, and the findings that say why not: which camera, at which step, what to do. */
function showVerdict() {
  const { verdict, headline = verdict, findings = [] } = header.summary ?? {};
  const part = byId("verdict");
  part.hidden = !verdict;
  part.dataset.verdict = verdict ?? "";
  if (!verdict) return;
  const where = ({ cameras, step }) =>
    [cameras.length > 3 ? "" : cameras.map((id) => `camera ${id}`).join(", "), step].filter(Boolean).join(" · ");
  part.replaceChildren(
    element("strong", {}, `${MARKS[verdict]} ${headline[0].toUpperCase()}${headline.slice(1)}`),
    element(
      "ul",
      {},
      ...findings.map((finding) =>
        element(
          "li",
          { "data-verdict": finding.verdict, "data-code": finding.code },
          element("b", {}, where(finding)),
          ` ${finding.sentence}`,
          finding.accepted ? " (accepted)" : "",
        ),
      ),
    ),
  );
}

/** What was not measured: areas by reason, and the photographs, loaded when the part is opened. */
function showUnmeasured() {
  const areas = header.place[0] === "live" ? null : header.summary?.unmeasured;
  const part = byId("unmeasured");
  part.hidden = !areas;
  byId("unmeasured-reasons").replaceChildren();
  byId("unmeasured-pictures").replaceChildren();
  if (!areas) return;
  part.firstElementChild.textContent = `Not measured: ${areas.total_cm2.toFixed(1)} cm² of the texture that two cameras see`;
  if (part.open) attempt(loadUnmeasured);
}

async function loadUnmeasured() {
  const of = header;
  const { reasons, cameras } = await get(own("unmeasured"));
  if (of !== header) return;
  byId("unmeasured-reasons").replaceChildren(
    ...reasons.map(({ reason, colour, cm2, counted: inTotal }) =>
      element("li", {}, element("i", { style: `background: ${colour}` }), `${reason}: ${cm2.toFixed(1)} cm²${inTotal ? "" : " (not in the total)"}`),
    ),
  );
  byId("unmeasured-pictures").replaceChildren(
    ...cameras.map((camera) => {
      const picture = element("img", { src: own("unmeasured", camera), loading: "lazy", alt: `Camera ${camera}: what was not measured` });
      const large = { href: `${own("unmeasured", camera)}?width=4096`, target: "_blank", rel: "noopener" };
      return element("figure", {}, element("a", large, picture), element("figcaption", {}, camera));
    }),
  );
}

/** The world's axes as the present view sees them. */
function drawAxes(axes) {
  for (const [k, [right, up]] of axes.entries()) {
    const name = "xyz"[k];
    const line = byId(`axis-${name}`);
    line.setAttribute("x2", String(24 * right));
    line.setAttribute("y2", String(-24 * up));
    const letter = byId(`letter-${name}`);
    letter.setAttribute("x", String(31 * right));
    letter.setAttribute("y", String(-31 * up));
  }
}

function wirePicking() {
  const canvas = byId("surface");
  const output = byId("pick");
  let due = null;
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons) {
      output.hidden = true;
      return;
    }
    cancelAnimationFrame(due);
    due = requestAnimationFrame(() => {
      const hit = surface.pick(event.clientX, event.clientY);
      output.hidden = !hit;
      if (!hit) return;
      const { x, y, z } = hit.position;
      const field = chosenField();
      const value = Number.isFinite(hit.value) ? `${figure(hit.value)} ${field.unit}` : "not measured";
      output.textContent = `${value}   at (${[x, y, z].map((mm) => mm.toFixed(1)).join(", ")}) mm`;
    });
  });
  canvas.addEventListener("pointerleave", () => {
    cancelAnimationFrame(due);
    output.hidden = true;
  });
}

function stop() {
  clearInterval(playing);
  playing = null;
  byId("play").textContent = "▶ Play";
  byId("play").setAttribute("aria-pressed", "false");
}

function play() {
  if (playing) {
    stop();
    return;
  }
  byId("play").textContent = "❚❚ Pause";
  byId("play").setAttribute("aria-pressed", "true");
  const next = () => {
    const slider = byId("step");
    slider.value = String((Number(slider.value) + 1) % header.steps.length);
    attempt(show);
  };
  next();
  playing = setInterval(next, PLAY_EVERY);
}

async function attempt(action) {
  try {
    await action();
  } catch (error) {
    stop();
    notice(error.message);
  }
}

export function wireResults() {
  byId("run").addEventListener("change", () => {
    byId("follow").checked = byId("run").value === LIVE;
    attempt(openChosen);
  });
  byId("follow").addEventListener("change", () => {
    const latest = newest();
    if (!following() || !latest) return;
    byId("run").value = latest.choice;
    attempt(() => openChosen(true));
  });
  byId("field").addEventListener("change", () => {
    limitsByHand = null;
    attempt(show);
  });
  byId("rigid").addEventListener("change", () => attempt(show));
  byId("step").addEventListener("input", () => {
    stop();
    attempt(show);
  });
  for (const id of ["low", "high"]) {
    byId(id).addEventListener("change", () => {
      typedLimits();
      attempt(show);
    });
  }
  byId("auto").addEventListener("click", () => {
    limitsByHand = null;
    limitsSoFar = new Map();
    attempt(show);
  });
  byId("reset-view").addEventListener("click", () => surface?.resetView());
  byId("play").addEventListener("click", play);
  byId("unmeasured").addEventListener("toggle", () => {
    if (byId("unmeasured").open && header) attempt(loadUnmeasured);
  });
}
