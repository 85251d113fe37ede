// The line beside the switch "Live": which step is shown, how soon after its last image, and which step comes next.

import { byId } from "./dom.js";
import { state } from "./live.js";

const shown = new Map(); // address of live results -> seconds from the last image to the drawing

const keyOf = ({ session, capture_id }) => `${session}/${capture_id}`;

/** Note that a live step has just been drawn. The time since its last image includes that since its event arrived. */
export function noteDrawn(header) {
  const { newest } = state;
  if (!newest || keyOf(newest) !== keyOf(header) || shown.has(keyOf(header))) return;
  const since = newest.arrived === undefined ? 0 : (performance.now() - newest.arrived) / 1000;
  if (newest.seconds !== null) shown.set(keyOf(header), newest.seconds + since);
  showFollowed();
}

function present() {
  const { newest } = state;
  if (!newest) return "";
  const seconds = shown.get(keyOf(newest)) ?? newest.seconds;
  return seconds === null ? newest.capture_id : `${newest.capture_id}, ${seconds.toFixed(1)} s after its last image`;
}

/** The step that is being processed or waits, or the last that failed. */
function coming() {
  const job = state.jobs.find((one) => one.session === state.current && one.step);
  if (!job) return "";
  if (job.state === "running") return `${job.step}: ${job.stage || "starting"}, ${Math.round(100 * job.done)} %`;
  if (job.state === "queued") return `${job.step} waits`;
  return job.state === "failed" ? `${job.step} failed: ${job.error}` : "";
}

export function showFollowed() {
  byId("live-step").textContent = present();
  byId("live-step").dataset.seconds = shown.get(state.newest ? keyOf(state.newest) : "")?.toFixed(3) ?? "";
  const next = coming();
  byId("live-next").textContent = next;
  byId("live-next").classList.toggle("bad", next.includes(" failed: "));
}
