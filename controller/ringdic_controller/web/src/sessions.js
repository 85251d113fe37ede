// The choice of the session, and the creation of a new one.

import { post, put, url } from "./api.js";
import { byId, counted, notice, setOptions } from "./dom.js";
import { state } from "./live.js";

export function showSessions() {
  const options = state.sessions.map(({ name, captures, runs }) => {
    const count = Object.values(captures).reduce((sum, n) => sum + n, 0);
    return { value: name, label: `${name} (${counted(count, "capture")}, ${counted(runs, "run")})` };
  });
  const none = [{ value: "", label: "no session yet" }];
  setOptions(byId("session-select"), options.length ? options : none, state.current ?? "");
  const rig = state.rig?.name;
  byId("session-name").disabled = byId("session-create").disabled = !rig;
  byId("session-create").title = rig ? "" : "The controller runs without a rig.toml, so no session can be created.";
}

export function wireSessions() {
  byId("session-select").addEventListener("change", async (event) => {
    try {
      await put(url("sessions", "current"), { name: event.target.value });
    } catch (error) {
      notice(error.message);
      showSessions();
    }
  });
  byId("session-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const input = byId("session-name");
    try {
      await post(url("sessions"), { name: input.value.trim() || null });
      input.value = "";
      notice("");
    } catch (error) {
      notice(error.message);
    }
  });
}
