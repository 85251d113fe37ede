// The operator's page: follows the live state and draws each part when it changes.

import { showAccount } from "./account.js";
import { showCapture, showCaptures, wireCaptures } from "./captures.js";
import { byId } from "./dom.js";
import { showJobs, wireJobs } from "./jobs.js";
import { follow, onChange, state } from "./live.js";
import { showNodes } from "./nodes.js";
import { showFollowed } from "./following.js";
import { showNewest, wireResults } from "./results.js";
import { showSessions, wireSessions } from "./sessions.js";

function showConnection() {
  const live = byId("live");
  live.textContent = state.connected ? "live" : "no answer from the controller, trying again …";
  live.classList.toggle("on", state.connected);
  showAccount(); // a login that has ended leads to the page to log in on
}

wireSessions();
wireCaptures();
wireJobs();
wireResults();

onChange((parts) => {
  const any = (...names) => names.some((name) => parts.has(name));
  if (any("connected")) showConnection();
  if (any("rig", "captures")) showNodes();
  if (any("sessions", "rig")) showSessions();
  if (any("rig", "round", "connected", "sessions")) showCapture();
  if (any("captures")) showCaptures();
  if (any("jobs", "sessions", "processing")) showJobs();
  if (any("jobs", "newest", "sessions", "captures")) showFollowed();
  if (any("runs", "newest")) showNewest();
});

follow();
