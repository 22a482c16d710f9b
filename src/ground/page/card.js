// What the chosen incident shows beside its heading.

import { html, svg } from "./dom.js";
import { mayAct } from "./session.js";
import { isDismissed, known, newestAlarm } from "./state.js";
import {
  adviceText, areaText, basis, clock, doubtText, heights, historyText, metres, places, seenBy, sizeText, spreadText, trendText,
} from "./words.js";

const button = (act, text, extra = {}) => html("button", { type: "button", "data-act": act, ...extra }, text);

export function body(feature) {
  const p = feature.properties, alarm = newestAlarm(feature.id);
  return [
    picture(feature), deeds(p), place(feature), facts(feature, alarm), intensityChart(alarm), doubts(p), members(p),
    note(p), history(feature.id),
  ];
}

function picture(feature) {
  if (!feature.properties.chip) return null;
  const src = `/incidents/${encodeURIComponent(feature.id)}/chip.jpg?row=${feature.properties.row}`;
  return html("figure", { class: "chip" }, html("img", { src, alt: `What the aircraft saw at ${feature.id}`, loading: "lazy" }));
}

function deeds(p) {
  if (!mayAct()) return null;
  const { state } = p.operator;
  const all = isDismissed(p)
    ? [button("confirm", "It is a fire", { class: "strong" })]
    : [
      state === "new" ? button("acknowledge", "Acknowledge", { class: "strong", "aria-keyshortcuts": "a" }) : null,
      state === "confirmed" ? null : button("confirm", "Confirm", { "aria-keyshortcuts": "c" }),
      button("dismiss", "No fire", { "aria-keyshortcuts": "d" }),
      known.incidents.size > 1 ? button("merge", "Same as…", { "aria-keyshortcuts": "m" }) : null,
    ];
  return html("div", { class: "deeds", role: "group", "aria-label": "What to do" }, ...all);
}

function place(feature) {
  const rows = places(feature.geometry.coordinates).flatMap(([kind, text]) => [
    html("span", { class: "kind" }, { decimal: "Dec", "degrees, minutes, seconds": "DMS" }[kind] ?? kind),
    html("span", { class: "value" }, text),
    html("button", { type: "button", "data-copy": text, "aria-label": `Copy ${kind}: ${text}` }, "Copy"),
  ]);
  return html("div", { class: "place" }, ...rows);
}

function facts(feature, alarm) {
  const p = feature.properties, list = html("dl", { class: "facts" });
  const rows = [
    ["Accuracy", `CE90 ${metres(p.ce90_m)}, LE90 ${metres(p.le90_m)}`],
    ["Height", heights(feature, alarm)],
    ["Size", sizeText(p, alarm)],
    ["Ground", areaText(alarm)],
    ["Intensity", trendText(p, alarm?.properties.trend_sigma)],
    ["Runs", spreadText(alarm)],
    ["Seen by", seenBy(p)],
    ["Based on", basis(p, alarm)],
    ["First seen", html("span", { "data-at": p.first_seen_at, title: p.first_seen_at }, "")],
    ["To place it better", adviceText(alarm)],
  ];
  for (const [term, text] of rows) if (text) list.append(html("dt", {}, term), html("dd", {}, text));
  return list;
}

// Intensity over the last minute: one line, its latest point, and the level at the start of it.
function intensityChart(alarm) {
  const points = alarm?.properties.intensity_history ?? [];
  if (points.length < 3) return null;
  const [w, h, air] = [360, 56, 4];
  const times = points.map(([t]) => t), levels = points.map(([, v]) => v);
  const first = Math.min(...times), last = Math.max(...times), top = Math.max(...levels, 1e-9) * 1.1;
  const at = ([t, v]) => [air + (w - 2 * air) * (t - first) / Math.max(last - first, 1e-9), h - air - (h - 2 * air) * v / top];
  const line = points.map((point, k) => `${k ? "L" : "M"}${at(point).map((v) => v.toFixed(1)).join(",")}`).join(" ");
  const change = levels.at(-1) / Math.max(levels[0], 1e-9);
  const words = `Intensity over ${Math.round(last - first)} s: now ${change.toFixed(1)} times what it was`;
  const [, start] = at(points[0]), [x, y] = at(points.at(-1));
  const chart = svg("svg", { class: "intensity", viewBox: `0 0 ${w} ${h}`, role: "img", "aria-label": words },
    svg("path", { class: "level", d: `M${air},${start} H${w - air}` }), svg("path", { class: "course", d: line }),
    svg("circle", { class: "now", cx: x, cy: y, r: 3.5 }));
  return html("figure", { class: "burning" }, chart, html("figcaption", {}, words));
}

function doubts(p) {
  if (!p.degraded.length) return null;
  const uav = p.alarms[0]?.uav ?? "";
  return html("ul", { class: "doubt", "aria-label": "Why the ring is wider" }, ...p.degraded.map((r) => html("li", {}, doubtText(r, uav))));
}

function members(p) {
  if (p.alarms.length < 2) return null;
  const rows = p.alarms.map((alarm) => html("li", {}, html("span", {}, `${alarm.alarm} by ${alarm.uav}, ±${metres(alarm.ce90_m)}`),
    mayAct() ? button("split", "Not this fire", { "data-with": alarm.alarm, "aria-label": `Not this fire: ${alarm.alarm}` }) : null));
  return html("div", { class: "members" }, html("h4", {}, "Put together from"), html("ul", {}, ...rows));
}

function note(p) {
  const { by, at, note: text } = p.operator;
  if (!by) return null;
  const knows = p.alarms.map((a) => a.aircraft_knows).filter((k) => k !== undefined && k !== null);
  const learned = knows.length ? (knows.every(Boolean) ? " The aircraft knows." : " The aircraft does not know yet.") : "";
  return html("p", { class: "note" }, `${by} at ${clock(at)}${text ? `: ${text}` : "."}${learned}`);
}

function history(id) {
  const lines = known.details.get(id)?.history ?? [];
  if (!lines.length) return null;
  const rows = lines.slice(0, 30).map((line) => html("li", {}, html("time", { datetime: line.at }, clock(line.at)), ` ${historyText(line)}`));
  return html("details", { class: "history" }, html("summary", { "data-act": "history" }, `History (${lines.length})`), html("ol", {}, ...rows));
}
