// The list of nodes: one tile for each camera, in ring order.

import { byId, element } from "./dom.js";
import { state } from "./live.js";

const megabytes = (bytes) => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(1)} GB` : `${Math.round(bytes / 1e6)} MB`);

function condition(node) {
  if (!node.alive) return ["gone", "not connected"];
  if (node.armed) return ["armed", "armed"];
  return ["alive", node.state && node.state !== "unknown" ? node.state : "ready"];
}

function lastStatus(id) {
  const entry = state.captures.at(-1)?.cameras?.[id];
  return entry ? { status: entry.status, reason: entry.reason } : null;
}

function tile(node) {
  const [kind, word] = condition(node);
  const last = lastStatus(node.id);
  const spool = [];
  if (node.spool_images) spool.push(`${node.spool_images} to deliver`);
  if (node.spool_free) spool.push(`${megabytes(node.spool_free)} free`);
  const details = [
    `camera ${node.id}`,
    node.azimuth_deg === undefined ? null : `azimuth ${node.azimuth_deg}°`,
    Number.isFinite(node.clock_offset_ms)
      ? `clock offset ${node.clock_offset_ms.toFixed(2)} ± ${(node.clock_error_ms ?? NaN).toFixed(2)} ms`
      : null,
    node.detail || null,
    last?.reason,
  ].filter(Boolean);
  return element(
    "li",
    { class: `node ${kind}`, "data-node": node.id, title: details.join("\n") },
    element("span", { class: "node-id" }, node.id),
    element("span", { class: "node-state" }, word),
    element("span", { class: `node-last ${last?.status ?? ""}` }, last ? `last: ${last.status.replace("-", " ")}` : "no capture"),
    element("span", { class: "node-spool" }, spool.join(", ") || " "),
    node.detail ? element("span", { class: "node-spool" }, node.detail) : null,
  );
}

export function showNodes() {
  const rig = state.rig;
  if (!rig) return;
  byId("rig-name").textContent = rig.name ?? "no rig: viewer only";
  const alive = rig.nodes.filter((node) => node.alive).length;
  byId("nodes-count").textContent = rig.nodes.length ? `${alive} of ${rig.nodes.length} connected` : "";
  byId("nodes").replaceChildren(
    ...(rig.nodes.length ? rig.nodes.map(tile) : [element("li", { class: "muted" }, "The controller runs without a rig.")]),
  );
}
