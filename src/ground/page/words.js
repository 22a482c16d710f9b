// Numbers and states in plain words.

import { decimal, dms, mgrs, utm } from "./coords.js";

export const CLASS = { fire: "Fire", smoke: "Smoke" };
export const SIGN = { fire: "▲", smoke: "●" };
export const STATE = {
  suspected: "suspected", confirmed: "confirmed", growing: "growing",
  steady: "steady", dying: "dying down", out: "out",
};
export const METHOD = { stereo: "stereo", parallax: "views from several places", terrain: "terrain model" };
const SIZE = { small: "small", medium: "medium", large: "large" };
const COMPASS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];
// Reasons that aircraft give; one that is not here is shown as it came.
const DOUBT = {
  mavlink_summary: "Came over the radio as a summary: the ring is a circle and details are missing.",
  mono: "One camera eye gave nothing: the range is less sure.",
  clock_not_synced: "Camera and autopilot clocks are not yet in step.",
  gnss_accuracy_unknown: "The GNSS receiver does not state its accuracy; the usual one is assumed.",
  geoid_applied: "The height comes from a geoid model, not from the receiver.",
  attitude_slow: "The autopilot’s attitude came too seldom.",
  position_slow: "The autopilot’s position came too seldom.",
  spectral_silent: "Spectrometer or near-infrared eye gives nothing: intensity is from the camera alone.",
  spectral_blinded: "Spectrometer or near-infrared eye is covered: intensity is from the camera alone.",
  spectral_frozen: "Spectrometer or near-infrared eye repeats itself: intensity is from the camera alone.",
  visible_silent: "The camera sees no flame there: intensity is from the spectrometer alone.",
  visible_blinded: "The camera’s view is covered: intensity is from the spectrometer alone.",
  visible_frozen: "The camera’s light does not change: intensity is from the spectrometer alone.",
};

export function age(ms) {
  const s = Math.max(0, Math.round(ms / 1000));
  if (s < 90) return `${s} s ago`;
  if (s < 5400) return `${Math.round(s / 60)} min ago`;
  if (s < 172800) return `${Math.round(s / 3600)} h ago`;
  return `${Math.round(s / 86400)} days ago`;
}

// Zero has no sign: -0.04 is "0.0 m".
export const metres = (m) => (Math.abs(m) < 10 ? m.toFixed(1).replace(/^-(0\.0)$/, "$1") : Math.round(m).toString()) + " m";
export const bearing = (deg) => `${String(Math.round(deg) % 360).padStart(3, "0")}°`;
const towards = (deg) => COMPASS[Math.round((((deg % 360) + 360) % 360) / 45) % 8];
export const clock = (at) => new Date(at).toLocaleTimeString("en-GB");

/** `Fire, growing`. */
export const title = (p) => `${CLASS[p.class] ?? p.class}, ${STATE[p.state] ?? p.state}`;
export const name = (p) => `${CLASS[p.class] ?? p.class} ${p.id}`;

export function operatorText({ state, by }) {
  const who = by ? ` by ${by}` : "";
  return { new: "New", acknowledged: `Acknowledged${who}`, confirmed: `Confirmed${who}`, dismissed: `Dismissed${who}` }[state] ?? state;
}

/** The ways in which a place is copied. */
export function places([lon, lat]) {
  const rows = [["decimal", decimal(lat, lon)], ["degrees, minutes, seconds", dms(lat, lon)]];
  const square = mgrs(lat, lon);
  if (square) rows.push(["MGRS", square], ["UTM", utm(lat, lon)]);
  return rows;
}

export function heights(feature, alarm) {
  const p = feature.properties, above = alarm?.properties.height_above_ground_m;
  const ground = above === null || above === undefined ? "" : `, ${metres(above)} above ground`;
  return `MSL ${p.altitude_msl_m.toFixed(1)} m, ellipsoid ${feature.geometry.coordinates[2].toFixed(1)} m${ground}`;
}

export function basis(p, alarm) {
  const methods = p.methods.map((m) => METHOD[m] ?? m).join(", ") || "not stated";
  const range = alarm ? `, last from ${metres(alarm.properties.range_m)}` : "";
  return `${methods}; ${p.sightings} sighting${p.sightings === 1 ? "" : "s"}${range}`;
}

export function seenBy(p) {
  const aircraft = [...new Set(p.alarms.map((a) => a.uav))];
  return `${aircraft.join(", ")}${p.alarms.length > 1 ? ` (${p.alarms.length} alarms)` : ""}`;
}

export function sizeText(p, alarm) {
  const from = alarm?.properties.size_m ? alarm.properties : p;
  if (!from.size_m) return null;
  const off = from.size_sigma_m;
  const side = (m, sigma) => metres(m) + (sigma ? ` ± ${metres(sigma)}` : "");
  const kind = SIZE[from.size_class] ? `${SIZE[from.size_class]}: ` : "";
  return `${kind}${side(from.size_m.width, off?.width)} wide, ${side(from.size_m.height, off?.height)} high`;
}

export function areaText(alarm) {
  const area = alarm?.properties.area?.square_metres;
  if (!area) return null;
  const digits = area.value < 10 ? 1 : 0, round = (v) => v.toFixed(digits);
  return `${round(area.value)} ± ${round(area.sigma)} m² burning`;
}

export function spreadText(alarm) {
  const s = alarm?.properties.spread;
  if (!s) return null;
  return `to the ${towards(s.azimuth_deg.value)} (${bearing(s.azimuth_deg.value)} ± ${Math.round(s.azimuth_deg.sigma)}°), `
    + `${s.speed_m_s.value.toFixed(2)} ± ${s.speed_m_s.sigma.toFixed(2)} m/s`;
}

const isNumber = (v) => v !== null && v !== undefined;

export function trendText(p, sigma) {
  if (!isNumber(p.trend)) return null;
  const percent = (v) => Math.abs(100 * v).toFixed(1);
  return `${p.trend < 0 ? "−" : "+"}${percent(p.trend)}${isNumber(sigma) ? ` ± ${percent(sigma)}` : ""} %/s`;
}

export function adviceText(alarm) {
  const a = alarm?.properties.advice;
  return a ? `fly ${metres(a.distance_m)} on course ${bearing(a.course_deg)}: CE90 about ${metres(a.ce90_m)}` : null;
}

export function doubtText(reason, uav) {
  const same = reason.match(/^merged_into_(\d+)$/)?.[1];
  return DOUBT[reason] ?? (same ? `Turned out to be the same fire as ${uav}-${same}.` : reason.replaceAll("_", " "));
}

/** One line of an incident's history. */
export function historyText(line) {
  if (line.kind === "alarm") {
    const p = line.alarm.properties ?? {};
    return `${p.uav}: revision ${p.revision}, ${STATE[p.state] ?? p.state}, ±${metres(p.ce90_m ?? 0)} (${line.link})`;
  }
  const { action } = line;
  const did = { acknowledge: "acknowledged", confirm: "confirmed", dismiss: "dismissed", merge: "merged", split: "split", undo: "took back" };
  return `${action.by} ${did[action.kind] ?? action.kind}${action.of ? ` action ${action.of}` : ""}${action.note ? `: ${action.note}` : ""}${action.undone ? " (taken back)" : ""}`;
}
