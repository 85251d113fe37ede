// The processing of the current session: progress, log, start and cancel.

import { getText, post, url } from "./api.js";
import { byId, clockTime, duration, element, notice } from "./dom.js";
import { state } from "./live.js";

const active = (job) => job.state === "running" || job.state === "queued";

/** The job to show: what runs or waits for this session, else its last one. Jobs of single steps are shown with the results. */
function present() {
  const own = state.jobs.filter((job) => job.session === state.current && !job.step);
  return own.find((job) => job.state === "running") ?? own.find(active) ?? own[0] ?? null;
}

function sentence(job) {
  if (job.state === "queued") return job.message || "waiting for its turn";
  if (job.state === "running") return [job.stage || "starting", job.message].filter(Boolean).join(": ");
  if (job.state === "done") return `done at ${clockTime(job.finished_at)}, run ${job.run}`;
  if (job.state === "failed") return job.error;
  return [job.state, job.message].filter(Boolean).join(": ");
}

function why(job) {
  return job.automatic ? `started by ${job.reason}` : job.reason;
}

function warmth() {
  const { state: how, compiling, seconds } = state.processing ?? {};
  if (how === "warming") return compiling ? "warming up: compiling its kernels, once on this machine …" : "warming up …";
  if (how === "ready") return `ready${seconds >= 20 ? `, after ${duration(seconds)} of compiling` : ""}`;
  return how === "ended" ? "stopped; starts again with the next job" : "";
}

export function showJobs() {
  byId("warmth").textContent = warmth();
  byId("warmth").dataset.state = state.processing?.state ?? "";
  const job = present();
  const box = byId("job");
  byId("job-cancel").hidden = !job || !active(job);
  const taken = Boolean(job && (job.state === "running" || (job.state === "queued" && !job.automatic)));
  byId("job-start").disabled = !state.current || taken; // an automatic job that waits for a pause in the captures can be started at once
  byId("job-log-box").hidden = !job;
  if (!job) {
    box.replaceChildren(element("p", { class: "muted" }, "No job in this session yet. Processing starts by itself after a specimen capture."));
    return;
  }
  const percent = Math.round(100 * job.done);
  const pace = [job.rate, job.left_s === null ? "" : `${duration(job.left_s)} left`].filter(Boolean).join(" · ");
  box.replaceChildren(
    element(
      "p",
      { class: "job-line" },
      element("b", { class: `job-state ${job.state}`, "data-state": job.state }, job.state),
      element("span", { class: "job-sentence" }, sentence(job)),
      element("span", { class: "muted job-why" }, `job ${job.id}, ${why(job)}`),
    ),
    element(
      "div",
      { class: "job-progress" },
      element("progress", { max: "1", value: String(job.done), "aria-label": "Progress of the processing" }),
      element("span", { class: "job-percent" }, `${percent} %`),
      element("span", { class: "muted job-pace" }, job.state === "running" ? pace : ""),
    ),
  );
  refreshLog();
}

let logAsked = 0;
let shownLog = "";

async function refreshLog(force = false) {
  const job = present();
  const box = byId("job-log-box");
  const now = Date.now();
  const key = job ? `${job.id} ${job.state}` : "";
  if (!job || !box.open || (!force && now - logAsked < 1000 && key === shownLog)) return;
  logAsked = now;
  shownLog = key;
  const pre = byId("job-log");
  try {
    const atEnd = pre.scrollTop + pre.clientHeight >= pre.scrollHeight - 4;
    pre.textContent = (await getText(url("jobs", job.id, "log"))) || "The log is empty.";
    if (atEnd) pre.scrollTop = pre.scrollHeight;
  } catch (error) {
    pre.textContent = error.message;
  }
}

export function wireJobs() {
  const attempt = (action) => async () => {
    try {
      await action();
      notice("");
    } catch (error) {
      notice(error.message);
    }
  };
  byId("job-start").addEventListener("click", attempt(() => post(url("jobs"), { session: state.current })));
  byId("job-cancel").addEventListener("click", attempt(() => post(url("jobs", present().id, "cancel"), {})));
  byId("job-log-box").addEventListener("toggle", () => refreshLog(true));
}
