// The live state of the controller, kept up to date by its event stream.

export const state = {
  rig: null,
  sessions: [],
  current: null,
  captures: [],
  runs: [],
  newest: null, // the newest live step: processed alone as soon as it was archived
  jobs: [],
  processing: null,
  round: null,
  connected: false,
};

const listeners = new Set();

/** Call `listener(names)` whenever the parts of the state with these names have changed. */
export function onChange(listener) {
  listeners.add(listener);
}

function changed(...names) {
  for (const listener of listeners) listener(new Set(names));
}

function replaceIn(list, key, item, atFront) {
  const index = list.findIndex((other) => other[key] === item[key]);
  if (index >= 0) return list.with(index, item);
  return atFront ? [item, ...list] : [...list, item];
}

const apply = {
  snapshot(snapshot) {
    Object.assign(state, snapshot);
    changed("rig", "sessions", "captures", "runs", "newest", "jobs", "processing", "round");
  },
  rig(rig) {
    state.rig = rig;
    changed("rig");
  },
  sessions({ sessions, current }) {
    Object.assign(state, { sessions, current });
    changed("sessions");
  },
  round(round) {
    state.round = round;
    changed("round");
  },
  capture({ session, record }) {
    if (session !== state.current) return;
    state.captures = replaceIn(state.captures, "capture_id", record, false);
    changed("captures");
  },
  job(job) {
    state.jobs = replaceIn(state.jobs, "id", job, true);
    changed("jobs");
  },
  runs({ session, runs }) {
    if (session !== state.current) return;
    state.runs = runs;
    changed("runs");
  },
  newest(newest) {
    if (newest.session !== state.current) return;
    state.newest = { ...newest, arrived: performance.now() };
    changed("newest");
  },
  processing(processing) {
    state.processing = processing;
    changed("processing");
  },
};

const AGAIN = 5000; // ms until the next attempt, where the browser makes none

/** Follow the event stream for as long as the page is open. The browser reconnects by itself, except after a refusal. */
export function follow() {
  const source = new EventSource("/api/v1/live");
  const connected = (yes) => {
    state.connected = yes;
    changed("connected");
  };
  source.addEventListener("open", () => connected(true));
  source.addEventListener("error", () => {
    connected(false);
    if (source.readyState === EventSource.CLOSED) setTimeout(follow, AGAIN);
  });
  for (const [name, update] of Object.entries(apply)) {
    source.addEventListener(name, (event) => update(JSON.parse(event.data)));
  }
}
