// The choice of the session, and the creation of a new one.

import { post, put, url } from "./api.js";
import { byId, counted, element, notice, setOptions } from "./dom.js";
import { state } from "./live.js";

export function showSessions() {
  const options = state.sessions.map(({ name, captures, runs, damaged }) => {
    const count = Object.values(captures).reduce((sum, n) => sum + n, 0);
    const harm = damaged.length ? ", damaged" : "";
    return { value: name, label: `${name} (${counted(count, "capture")}, ${counted(runs, "run")}${harm})` };
  });
  const none = [{ value: "", label: "no session yet" }];
  setOptions(byId("session-select"), options.length ? options : none, state.current ?? "");
  const sentences = state.sessions.flatMap(({ name, damaged }) => damaged.map((sentence) => `${name}: ${sentence}`));
  byId("damaged").replaceChildren(...sentences.map((sentence) => element("li", {}, sentence)));
  byId("damaged").hidden = sentences.length === 0;
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
