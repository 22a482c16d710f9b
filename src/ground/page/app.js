// The duty officer's page. One stream of events in, one drawing and one list out; nothing from elsewhere.

const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";

// --- what is known ---------------------------------------------------------------------------

const known = {
  store: null, // name of the ground's store; another one means: forget everything
  incidents: new Map(), // alarm id -> { feature, summary: from MAVLink only }
  aircraft: new Map(), // name -> { points: [[lon, lat, h]..], latest }
  chosen: null,
  clockAhead: 0, // ms that the ground's clock is ahead of this browser's
  heardAt: 0, // when anything last came, by this browser's clock
};
const MAX_POINTS = 3600;
const SILENT_MS = 12000; // the ground tells its time every 5 s

const isSummary = (p) => p.degraded.includes("mavlink_summary");
const now = () => Date.now() + known.clockAhead;
const isOpen = (p) => p.state !== "out";

function takeAlarm(feature) {
  const p = feature.properties;
  const before = known.incidents.get(p.id)?.properties;
  // The stream may repeat itself after a resume; a summary never replaces the whole.
  if (before && (p.revision < before.revision || (p.revision === before.revision && isSummary(p)))) return;
  known.incidents.set(p.id, feature);
  if (!before || before.state !== p.state) announce(feature, !before);
}

function takePosition(ping) {
  const craft = known.aircraft.get(ping.uav) ?? { points: [], latest: null };
  if (craft.latest && ping.at < craft.latest.at) return;
  craft.latest = ping;
  craft.points.push([ping.longitude_deg, ping.latitude_deg, ping.height_ellipsoid_m]);
  if (craft.points.length > MAX_POINTS) craft.points.shift();
  known.aircraft.set(ping.uav, craft);
}

function takeTracks(collection) {
  for (const { geometry, properties } of collection.features) {
    const points = geometry.type === "Point" ? [geometry.coordinates] : geometry.coordinates;
    const craft = known.aircraft.get(properties.uav);
    const newer = craft?.latest && craft.latest.at > properties.at ? craft.latest : properties;
    known.aircraft.set(properties.uav, { points, latest: newer });
  }
}

// --- words -----------------------------------------------------------------------------------

const CLASS = { fire: "Fire", smoke: "Smoke" };
const SIGN = { fire: "▲", smoke: "●" };
const STATE = {
  suspected: "suspected", confirmed: "confirmed", growing: "growing",
  steady: "steady", dying: "dying down", out: "out",
};
const METHOD = { stereo: "stereo", parallax: "views from several places", terrain: "terrain model" };
// Reasons that aircraft give, in plain words; one that is not here is shown as it came.
const DOUBT = {
  mavlink_summary: "Came over the radio as a summary: the ring is a circle and details are missing.",
  mono: "One camera eye gave nothing: the range is less sure.",
  clock_not_synced: "Camera and autopilot clocks are not yet in step.",
  gnss_accuracy_unknown: "The GNSS receiver does not state its accuracy; the usual one is assumed.",
  geoid_applied: "The height comes from a geoid model, not from the receiver.",
  attitude_slow: "The autopilot’s attitude came too seldom.",
  position_slow: "The autopilot’s position came too seldom.",
  spectral_silent: "The spectrometer gives nothing: intensity is from the camera alone.",
  spectral_blinded: "The spectrometer is covered: intensity is from the camera alone.",
  spectral_frozen: "The spectrometer repeats itself: intensity is from the camera alone.",
  visible_silent: "The camera sees no flame there: intensity is from the spectrometer alone.",
  visible_blinded: "The camera’s view is covered: intensity is from the spectrometer alone.",
  visible_frozen: "The camera’s light does not change: intensity is from the spectrometer alone.",
};

function age(ms) {
  const s = Math.max(0, Math.round(ms / 1000));
  if (s < 90) return `${s} s ago`;
  if (s < 5400) return `${Math.round(s / 60)} min ago`;
  if (s < 172800) return `${Math.round(s / 3600)} h ago`;
  return `${Math.round(s / 86400)} days ago`;
}

const metres = (m) => (Math.abs(m) < 10 ? m.toFixed(1) : Math.round(m).toString()) + " m";

function decimal(lat, lon) {
  return `${lat.toFixed(6)}, ${lon.toFixed(6)}`;
}

function dms(lat, lon) {
  const part = (value, positive, negative) => {
    // In hundredths of a second first, so that 59.999 never prints as 60.00.
    const total = Math.round(Math.abs(value) * 360000);
    const d = Math.floor(total / 360000), m = Math.floor(total / 6000) % 60, s = (total % 6000) / 100;
    return `${d}°${String(m).padStart(2, "0")}′${s.toFixed(2).padStart(5, "0")}″${value < 0 ? negative : positive}`;
  };
  return `${part(lat, "N", "S")} ${part(lon, "E", "W")}`;
}

function name(feature) {
  const p = feature.properties;
  return `${CLASS[p.class] ?? p.class} ${p.id}`;
}

function announce(feature, isNew) {
  const p = feature.properties;
  $("announce").textContent = `${isNew ? "New: " : ""}${name(feature)}, ${STATE[p.state] ?? p.state}`;
}

// --- geometry --------------------------------------------------------------------------------

// Metres east and north of the first thing seen, in its tangent plane (radii of curvature of
// WGS84). Good to a few parts in a thousand within 50 km, which is for drawing only: the
// coordinates in the list are the alarm's own.
let plane = null;

function toPlane([lon, lat]) {
  if (!plane) {
    const phi = (lat * Math.PI) / 180, e2 = 0.00669437999014, a = 6378137;
    const w2 = 1 - e2 * Math.sin(phi) ** 2, rad = Math.PI / 180;
    plane = { lon, lat, east: (a / Math.sqrt(w2)) * Math.cos(phi) * rad, north: ((a * (1 - e2)) / w2 ** 1.5) * rad };
  }
  const turn = ((((lon - plane.lon + 180) % 360) + 360) % 360) - 180;
  return [turn * plane.east, (lat - plane.lat) * plane.north];
}

const fromPlane = ([x, y]) => [plane.lon + x / plane.east, plane.lat + y / plane.north];

// Half-axes in metres and the larger one's direction of the ellipse that holds 90 %.
function ellipse(c) {
  const [a, b, d] = [c[0], (c[1] + c[3]) / 2, c[4]];
  const mean = (a + d) / 2, half = Math.hypot((a - d) / 2, b), k = Math.sqrt(-2 * Math.log(0.1));
  return {
    major: k * Math.sqrt(Math.max(0, mean + half)), minor: k * Math.sqrt(Math.max(0, mean - half)),
    degrees: (0.5 * Math.atan2(2 * b, a - d) * 180) / Math.PI,
  };
}

// --- the map ---------------------------------------------------------------------------------

const chart = $("chart");
const view = { x: 0, y: 0, scale: 1, following: true }; // centre in metres, pixels per metre
const MIN_SCALE = 1e-4, MAX_SCALE = 200;

const size = () => ({ w: chart.clientWidth || 1, h: chart.clientHeight || 1 });
function toScreen([x, y]) {
  const { w, h } = size();
  return [w / 2 + (x - view.x) * view.scale, h / 2 - (y - view.y) * view.scale];
}
function fromScreen(px, py) {
  const { w, h } = size();
  return [view.x + (px - w / 2) / view.scale, view.y - (py - h / 2) / view.scale];
}

function el(tag, attributes = {}, ...children) {
  const e = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
  e.append(...children);
  return e;
}

function fitAll() {
  const xs = [], ys = [];
  const add = ([x, y], r = 0) => { xs.push(x - r, x + r); ys.push(y - r, y + r); };
  for (const f of known.incidents.values()) {
    add(toPlane(f.geometry.coordinates), ellipse(f.properties.covariance_enu_m2).major);
  }
  for (const craft of known.aircraft.values()) craft.points.forEach((p) => add(toPlane(p)));
  if (!xs.length) return;
  const { w, h } = size();
  const least = (values) => values.reduce((a, b) => Math.min(a, b)), most = (values) => values.reduce((a, b) => Math.max(a, b));
  const [x0, x1, y0, y1] = [least(xs), most(xs), least(ys), most(ys)];
  // Buttons stand at the left, labels reach to the right, the scale lies below.
  const edge = { left: 84, right: Math.min(110, w / 5), top: 44, bottom: 64 };
  const room = Math.min((w - edge.left - edge.right) / Math.max(x1 - x0, 12), (h - edge.top - edge.bottom) / Math.max(y1 - y0, 12));
  view.scale = Math.min(Math.max(room, MIN_SCALE), MAX_SCALE);
  view.x = (x0 + x1) / 2 + (edge.right - edge.left) / 2 / view.scale;
  view.y = (y0 + y1) / 2 - (edge.bottom - edge.top) / 2 / view.scale;
}

function zoom(factor, px, py) {
  const { w, h } = size();
  const [ax, ay] = [px ?? w / 2, py ?? h / 2];
  const [x, y] = fromScreen(ax, ay);
  view.scale = Math.min(Math.max(view.scale * factor, MIN_SCALE), MAX_SCALE);
  view.x = x - (ax - w / 2) / view.scale;
  view.y = y + (ay - h / 2) / view.scale;
  view.following = false;
  draw();
}

function pan(dx, dy) {
  view.x -= dx / view.scale;
  view.y += dy / view.scale;
  view.following = false;
  draw();
}

// The longest of 1, 2, 5 times a power of ten that fits in `pixels`.
function roundLength(pixels) {
  const most = pixels / view.scale, ten = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].map((n) => n * ten).find((n) => n <= most);
}

function drawGrid() {
  const { w, h } = size(), step = roundLength(180), group = el("g", { class: "grid", "aria-hidden": "true" });
  const [x0, y1] = fromScreen(0, 0), [x1, y0] = fromScreen(w, h);
  for (let x = Math.ceil(x0 / step) * step; x < x1; x += step) {
    const [px] = toScreen([x, 0]);
    group.append(el("line", { x1: px, x2: px, y1: 0, y2: h }));
  }
  for (let y = Math.ceil(y0 / step) * step; y < y1; y += step) {
    const [, py] = toScreen([0, y]);
    group.append(el("line", { x1: 0, x2: w, y1: py, y2: py }));
  }
  return group;
}

function drawCraft([uav, craft], taken) {
  const line = craft.points.map((p) => toScreen(toPlane(p)).map((v) => v.toFixed(1)).join(",")).join(" ");
  const { latest } = craft;
  const [x, y] = toScreen(toPlane([latest.longitude_deg, latest.latitude_deg]));
  const body = latest.heading_deg === null
    ? el("path", { d: "M-6,0a6,6 0 1,0 12,0a6,6 0 1,0 -12,0" })
    : el("path", { d: "M0,-13 L8,10 L0,5 L-8,10Z", transform: `rotate(${latest.heading_deg})` });
  const silent = now() - Date.parse(latest.at) > SILENT_MS;
  const mark = el("g", { class: `craft${silent ? " silent" : ""}`, transform: `translate(${x},${y})` }, body);
  const label = el("text", { class: "label" });
  label.textContent = uav;
  place(label, [x, y], taken);
  mark.append(label);
  return [el("polyline", { class: "track", points: line }), mark];
}

// Places a label beside a sign where it covers no other: right, left, below, above, else right.
function place(label, [x, y], taken) {
  const width = 7.7 * label.textContent.length, height = 18;
  const spots = [
    [14, 5, "start", 14], [-14, 5, "end", -14 - width],
    [0, 28, "middle", -width / 2], [0, -18, "middle", -width / 2],
  ].map(([dx, dy, anchor, left]) => ({ dx, dy, anchor, box: [x + left, y + dy - 14, x + left + width, y + dy - 14 + height] }));
  const clear = ({ box }) => taken.every((t) => box[2] < t[0] || box[0] > t[2] || box[3] < t[1] || box[1] > t[3]);
  const inside = ({ box }) => box[0] > (box[1] < 200 ? 60 : 2) && box[2] < size().w - 2;
  const spot = spots.find((s) => clear(s) && inside(s)) ?? spots[0];
  taken.push(spot.box);
  for (const [key, value] of [["x", spot.dx], ["y", spot.dy], ["text-anchor", spot.anchor]]) label.setAttribute(key, value);
}

// Burning ground and front line, in the mark's own coordinates; from another aircraft there may be none.
function drawArea(p, [x, y]) {
  const path = (corners) => corners.map((corner, k) => {
    const [px, py] = toScreen(toPlane(corner));
    return `${k ? "L" : "M"}${(px - x).toFixed(1)},${(py - y).toFixed(1)}`;
  }).join(" ");
  const polygon = p.area?.polygon;
  if (!polygon?.length || p.state === "out") return [];
  const ground = el("path", { class: "ground", d: `${path(polygon)}Z` });
  // The front's corners may run over the polygon's seam: begin after the gap.
  const inFront = new Set(p.area.front.map(String));
  const start = polygon.findIndex((c, k) => inFront.has(String(c)) && !inFront.has(String(polygon.at(k - 1))));
  if (start < 0) return [ground];
  const turned = [...polygon.slice(start), ...polygon.slice(0, start)].filter((c) => inFront.has(String(c)));
  return [ground, el("path", { class: "front", d: path(turned) })];
}

function drawFire(feature, taken) {
  const p = feature.properties, [x, y] = toScreen(toPlane(feature.geometry.coordinates));
  const { major, minor, degrees } = ellipse(p.covariance_enu_m2);
  const [rx, ry] = [major * view.scale, minor * view.scale];
  const mark = el("g", {
    class: "mark", "data-id": p.id, "data-class": p.class, "data-state": p.state,
    "data-chosen": String(p.id === known.chosen), transform: `translate(${x},${y})`,
    role: "button", tabindex: "0",
    "aria-label": `${name(feature)}, ${STATE[p.state] ?? p.state}, within ${metres(p.ce90_m)} at 90 percent`,
  });
  // SVG turns clockwise with y down; the ellipse's direction runs from east towards north.
  mark.append(el("ellipse", { class: "ring", rx, ry, transform: `rotate(${-degrees})` }));
  mark.append(p.class === "smoke" ? el("circle", { class: "sign", r: 6 }) : el("path", { class: "sign", d: "M0,-9 L8,5 L-8,5Z" }));
  const [ground, front] = drawArea(p, [x, y]);
  if (ground) mark.prepend(ground);
  if (front) mark.append(front);
  const label = el("text", { class: "label" });
  label.textContent = p.id;
  const fine = el("tspan", { class: "fine" });
  fine.textContent = `  ±${metres(p.ce90_m)}${p.state === "confirmed" ? "" : `, ${STATE[p.state] ?? p.state}`}`;
  label.append(fine);
  place(label, [x, y], taken);
  mark.append(label);
  return mark;
}

function draw() {
  const things = known.incidents.size + known.aircraft.size;
  $("empty").hidden = things > 0;
  if (!things) { chart.replaceChildren(); $("scale").hidden = true; return; }
  toPlane(first());
  if (view.following) fitAll();
  const focused = document.activeElement?.dataset?.id;
  const incidents = sorted();
  const taken = incidents.map((f) => toScreen(toPlane(f.geometry.coordinates))).map(([x, y]) => [x - 9, y - 9, x + 9, y + 9]);
  const fires = incidents.map((f) => drawFire(f, taken)).reverse(); // the most urgent is drawn last, on top
  const [tracks, crafts] = [[], []];
  for (const entry of known.aircraft) {
    const [track, craft] = drawCraft(entry, taken);
    tracks.push(track);
    crafts.push(craft);
  }
  chart.replaceChildren(drawGrid(), ...tracks, ...fires, ...crafts);
  if (focused) [...chart.querySelectorAll(".mark")].find((m) => m.dataset.id === focused)?.focus();
  const length = roundLength(150);
  $("scale").hidden = false;
  $("scale-text").textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
  $("scale-bar").style.width = `${length * view.scale}px`;
}

function first() {
  const [fire] = known.incidents.values(), [craft] = known.aircraft.values();
  return fire ? fire.geometry.coordinates : craft.points[0];
}

// --- the list --------------------------------------------------------------------------------

// Open before suspected before out, then by name: an entry does not jump with every sighting.
function sorted() {
  const group = (p) => (p.state === "out" ? 2 : p.state === "suspected" ? 1 : 0);
  return [...known.incidents.values()].sort((a, b) => {
    const [p, q] = [a.properties, b.properties];
    return group(p) - group(q) || p.id.localeCompare(q.id, "en", { numeric: true });
  });
}

function html(tag, attributes = {}, ...children) {
  const e = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) e.setAttribute(key, value);
  e.append(...children);
  return e;
}

function copyRow(kind, text) {
  const button = html("button", { type: "button", "data-copy": text, "aria-label": `Copy ${kind}: ${text}` }, "Copy");
  return [html("span", { class: kind === "decimal" ? "decimal" : "dms" }, text), button];
}

function heights(feature) {
  const p = feature.properties;
  const above = p.height_above_ground_m === null ? "" : `, ${metres(p.height_above_ground_m)} above ground`;
  return `MSL ${p.altitude_msl_m.toFixed(1)} m, ellipsoid ${feature.geometry.coordinates[2].toFixed(1)} m${above}`;
}

function basis(p) {
  if (isSummary(p)) return `not told over the radio; last seen from ${metres(p.range_m)}`;
  const methods = p.methods.map((m) => METHOD[m] ?? m).join(", ") || "not stated";
  return `${methods}; ${p.sightings} sighting${p.sightings === 1 ? "" : "s"}, last from ${metres(p.range_m)}`;
}

// --- how it burns ----------------------------------------------------------------------------

const SIZE = { small: "small", medium: "medium", large: "large" };
const COMPASS = ["north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west"];
const towards = (deg) => COMPASS[Math.round((((deg % 360) + 360) % 360) / 45) % 8];

function sizeText(p) {
  if (!p.size_m) return null;
  const off = p.size_sigma_m;
  const side = (m, sigma) => metres(m) + (sigma ? ` ± ${metres(sigma)}` : "");
  const kind = SIZE[p.size_class] ? `${SIZE[p.size_class]}: ` : "";
  return `${kind}${side(p.size_m.width, off?.width)} wide, ${side(p.size_m.height, off?.height)} high`;
}

function areaText(p) {
  const area = p.area?.square_metres;
  if (!area) return null;
  const round = (v) => (v < 10 ? v.toFixed(1) : Math.round(v).toString());
  return `${round(area.value)} ± ${round(area.sigma)} m² burning`;
}

function spreadText(p) {
  const s = p.spread;
  if (!s) return null;
  const deg = String(Math.round(s.azimuth_deg.value) % 360).padStart(3, "0");
  return `to the ${towards(s.azimuth_deg.value)} (${deg}° ± ${Math.round(s.azimuth_deg.sigma)}°), `
    + `${s.speed_m_s.value.toFixed(2)} ± ${s.speed_m_s.sigma.toFixed(2)} m/s`;
}

function trendText(p) {
  if (p.trend === null || p.trend === undefined) return null;
  const percent = (v) => Math.abs(100 * v).toFixed(1);
  const sign = p.trend < 0 ? "−" : "+";
  const off = p.trend_sigma === null || p.trend_sigma === undefined ? "" : ` ± ${percent(p.trend_sigma)}`;
  return `${sign}${percent(p.trend)}${off} % per second`;
}

// Intensity over the last minute: one line, its latest point, and the level at the start of it.
function intensityChart(p) {
  const points = p.intensity_history ?? [];
  if (points.length < 3) return null;
  const [w, h, air] = [360, 56, 4];
  const times = points.map(([t]) => t), levels = points.map(([, v]) => v);
  const first = Math.min(...times), last = Math.max(...times), top = Math.max(...levels, 1e-9) * 1.1;
  const place = ([t, v]) => [air + (w - 2 * air) * (t - first) / Math.max(last - first, 1e-9), h - air - (h - 2 * air) * v / top];
  const line = points.map((point, k) => `${k ? "L" : "M"}${place(point).map((v) => v.toFixed(1)).join(",")}`).join(" ");
  const change = levels.at(-1) / Math.max(levels[0], 1e-9);
  const words = `Intensity over ${Math.round(last - first)} s: now ${change.toFixed(1)} times what it was`;
  const svg = el("svg", { class: "intensity", viewBox: `0 0 ${w} ${h}`, role: "img", "aria-label": words });
  const [, start] = place(points[0]), [x, y] = place(points.at(-1));
  svg.append(el("path", { class: "level", d: `M${air},${start} H${w - air}` }), el("path", { class: "course", d: line }),
    el("circle", { class: "now", cx: x, cy: y, r: 3.5 }));
  return html("figure", { class: "burning" }, svg, html("figcaption", {}, words));
}

function facts(rows) {
  const list = html("dl", { class: "facts" });
  for (const [term, text] of rows) if (text) list.append(html("dt", {}, term), html("dd", {}, text));
  return list;
}

function entry(feature) {
  const p = feature.properties, [lon, lat] = feature.geometry.coordinates;
  const item = html("li", { class: "incident", "data-id": p.id, "data-class": p.class, "data-state": p.state,
    "data-chosen": String(p.id === known.chosen) });
  const title = html("button", { type: "button", "data-choose": p.id, "aria-pressed": String(p.id === known.chosen) },
    html("span", { class: "sign-text", "aria-hidden": "true" }, p.state === "out" ? (p.class === "smoke" ? "○" : "△") : SIGN[p.class] ?? "■"),
    `${CLASS[p.class] ?? p.class}, ${STATE[p.state] ?? p.state}`);
  const when = html("span", { class: "age", "data-at": p.captured_at, title: p.captured_at }, age(now() - Date.parse(p.captured_at)));
  const what = html("p", { class: "what" }, `${p.id} · ${Math.round(p.confidence * 100)} % sure · first seen `,
    html("span", { "data-at": p.first_seen_at, title: p.first_seen_at }, age(now() - Date.parse(p.first_seen_at))));
  item.append(html("div", { class: "head" }, html("h3", {}, title), when), what);
  item.append(html("div", { class: "place" }, ...copyRow("decimal", decimal(lat, lon)), ...copyRow("degrees, minutes, seconds", dms(lat, lon))));
  item.append(facts([
    ["Accuracy", `CE90 ${metres(p.ce90_m)}, LE90 ${metres(p.le90_m)}`],
    ["Height", heights(feature)],
    ["Size", sizeText(p)],
    ["Ground", areaText(p)],
    ["Intensity", trendText(p)],
    ["Runs", spreadText(p)],
    ["Based on", basis(p)],
    ["To place it better", p.advice && `fly ${metres(p.advice.distance_m)} on course ${String(Math.round(p.advice.course_deg)).padStart(3, "0")}°: CE90 about ${metres(p.advice.ce90_m)}`],
  ]));
  const burning = intensityChart(p);
  if (burning) item.append(burning);
  if (p.degraded.length) {
    const same = (reason) => reason.match(/^merged_into_(\d+)$/)?.[1];
    const plain = (reason) => DOUBT[reason]
      ?? (same(reason) ? `Turned out to be the same fire as ${p.uav}-${same(reason)}.` : reason.replaceAll("_", " "));
    item.append(html("ul", { class: "doubt", "aria-label": "Why the ring is wider" }, ...p.degraded.map((r) => html("li", {}, plain(r)))));
  }
  return item;
}

// Only what changed is replaced, so that focus and a half-made selection survive.
const shown = new Map(); // id -> what it was drawn from
function list() {
  const incidents = sorted(), items = $("incidents");
  $("none").hidden = incidents.length > 0;
  const old = new Map([...items.children].map((item) => [item.dataset.id, item]));
  incidents.forEach((feature, place) => {
    const { id } = feature.properties, key = `${JSON.stringify(feature)}${id === known.chosen}`;
    let item = old.get(id);
    if (!item || shown.get(id) !== key) {
      const fresh = entry(feature), focused = item?.contains(document.activeElement) && focusKey(document.activeElement);
      if (item) item.replaceWith(fresh); else items.append(fresh);
      if (focused) [...fresh.querySelectorAll("button")].find((b) => focusKey(b) === focused)?.focus();
      item = fresh;
      shown.set(id, key);
    }
    if (items.children[place] !== item) items.insertBefore(item, items.children[place]);
    old.delete(id);
  });
  for (const [id, item] of old) { item.remove(); shown.delete(id); }
}
const focusKey = (button) => (button.dataset.choose ? "choose" : button.getAttribute("aria-label")?.split(":")[0]);

function craftList() {
  $("aircraft-section").hidden = known.aircraft.size === 0;
  $("aircraft").replaceChildren(...[...known.aircraft].map(([uav, { latest }]) => {
    const quiet = now() - Date.parse(latest.at), silent = quiet > SILENT_MS;
    const heading = latest.heading_deg === null ? "" : `, heading ${String(Math.round(latest.heading_deg) % 360).padStart(3, "0")}°`;
    return html("li", { class: "aircraft" }, html("b", {}, uav), silent ? " " : ` ${latest.health === "ok" ? "healthy" : latest.health}, `,
      html("span", silent ? { class: "silent" } : {}, silent ? `silent, last heard ${age(quiet)}` : age(quiet)),
      `, ${latest.height_ellipsoid_m.toFixed(0)} m above ellipsoid${heading}`);
  }));
}

function summary() {
  const all = [...known.incidents.values()].map((f) => f.properties).filter(isOpen);
  const sure = all.filter((p) => p.state !== "suspected"), guess = all.length - sure.length;
  const fires = sure.filter((p) => p.class === "fire").length, smoke = sure.length - fires;
  const count = (n, one, many) => (n ? [`${n} ${n === 1 ? one : many}`] : []);
  const words = [...count(fires, "open fire", "open fires"), ...count(smoke, "smoke", "smokes"), ...count(guess, "suspected", "suspected")];
  $("summary").textContent = words.join(", ") || "No open fire";
  document.title = `${sure.length ? `(${sure.length}) ` : ""}${lost ? "No connection · " : ""}Fires · emberfix`;
}

// --- keeping up ------------------------------------------------------------------------------

let pending = false;
function refresh() {
  if (pending) return;
  pending = true;
  // A timer, not an animation frame: a page in the background keeps its title right.
  setTimeout(() => { pending = false; list(); craftList(); summary(); draw(); }, 40);
}

function tick() {
  for (const e of document.querySelectorAll("[data-at]")) e.textContent = age(now() - Date.parse(e.dataset.at));
  const ground = new Date(now());
  const [local, utc] = [ground.toLocaleTimeString("en-GB"), ground.toISOString().slice(11, 19)];
  $("clock").textContent = local === utc ? `${utc} UTC` : `${local} · ${utc} UTC`;
  craftList();
  if (known.heardAt && Date.now() - known.heardAt > SILENT_MS) { lose(); connect(); }
}

let lost = false;
function lose() {
  if (!lost) {
    lost = true;
    const since = new Date(known.heardAt || Date.now()).toLocaleTimeString("en-GB");
    $("banner").textContent = known.heardAt
      ? `No connection to the ground station. What you see is as of ${since}; it may have changed. Trying again.`
      : "No connection to the ground station yet. Trying again.";
    $("banner").hidden = false;
    $("line").dataset.state = "lost";
    $("line-text").textContent = "Not connected";
    summary();
  }
}

function heard() {
  known.heardAt = Date.now();
  if (lost || $("line").dataset.state !== "live") {
    lost = false;
    $("banner").hidden = true;
    $("line").dataset.state = "live";
    $("line-text").textContent = "Live";
    summary();
  }
}

const setClock = (text) => { known.clockAhead = Date.parse(text) - Date.now(); };

let stream = null, lastId = null, retry = 0;
function connect() {
  stream?.close();
  clearTimeout(retry);
  known.heardAt = known.heardAt && Date.now(); // a new attempt gets its own patience
  stream = new EventSource(lastId === null ? "/events" : `/events?last_event_id=${lastId}`);
  const on = (kind, take) => stream.addEventListener(kind, (event) => {
    heard();
    take(JSON.parse(event.data), event);
    refresh();
  });
  on("hello", (hello) => {
    setClock(hello.now);
    if (known.store && known.store !== hello.store) {
      // Another store counts its rows anew: nothing that we know holds there.
      known.incidents.clear();
      known.aircraft.clear();
      known.store = lastId = null;
      connect();
      return;
    }
    known.store = hello.store;
    fetch("/track.geojson").then((r) => r.json()).then(takeTracks).then(refresh).catch(() => {});
  });
  on("time", (time) => setClock(time.now));
  on("alarm", (feature, event) => { lastId = event.lastEventId; takeAlarm(feature); });
  on("track", takePosition);
  on("test", ({ at, link, uav }) => {
    $("tested-text").textContent = `${new Date(at).toLocaleTimeString("en-GB")}: test alarm from ${uav} over ${link} arrived. There is no fire.`;
    $("tested").hidden = false;
  });
  on("refused", ({ at, link, reason }) => {
    $("refused-text").textContent = `${new Date(at).toLocaleTimeString("en-GB")}: a report over ${link} was not taken. ${reason}`;
    $("refused").hidden = false;
  });
  stream.onerror = () => {
    lose();
    // The browser itself tries again after a broken line, but not after a refusal.
    if (stream.readyState === EventSource.CLOSED) retry = setTimeout(connect, 3000);
  };
}

// --- hands -----------------------------------------------------------------------------------

function choose(id) {
  known.chosen = known.chosen === id ? null : id;
  list();
  draw();
  if (known.chosen === null) return;
  [...$("incidents").children].find((item) => item.dataset.id === id)?.scrollIntoView({ block: "nearest" });
}

async function copy(button) {
  const text = button.dataset.copy;
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // Browsers keep the clipboard from pages that come over plain HTTP from another machine.
    const area = html("textarea", {});
    area.value = text;
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
    button.focus();
  }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
}

$("incidents").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (button?.dataset.copy) copy(button);
  else if (button?.dataset.choose) choose(button.dataset.choose);
});

const fingers = new Map();
let moved = 0;
chart.addEventListener("pointerdown", (event) => {
  fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  moved = 0;
});
chart.addEventListener("pointermove", (event) => {
  const at = [event.offsetX, event.offsetY], before = fingers.get(event.pointerId);
  if (!before) { point(at); return; }
  const step = [at[0] - before[0], at[1] - before[1]];
  moved += Math.hypot(...step);
  if (moved < 4) return;
  if (!chart.hasPointerCapture(event.pointerId)) chart.setPointerCapture(event.pointerId);
  chart.classList.add("dragging");
  const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
  fingers.set(event.pointerId, at);
  if (!other) { pan(...step); return; }
  const reach = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
  zoom(reach(at) / reach(before), (at[0] + other[0]) / 2, (at[1] + other[1]) / 2);
});
const lift = (event) => {
  fingers.delete(event.pointerId);
  chart.classList.remove("dragging");
};
chart.addEventListener("pointerup", lift);
chart.addEventListener("pointercancel", lift);
chart.addEventListener("pointerleave", () => { $("pointer").textContent = ""; });
chart.addEventListener("click", (event) => {
  const mark = event.target.closest(".mark");
  if (mark && moved < 4) choose(mark.dataset.id);
});
chart.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)), event.offsetX, event.offsetY);
}, { passive: false });

function point([px, py]) {
  if (!plane) return;
  const [lon, lat] = fromPlane(fromScreen(px, py));
  $("pointer").textContent = decimal(lat, lon);
}

function fit() { view.following = true; draw(); }
$("tested-seen").addEventListener("click", () => { $("tested").hidden = true; });
$("refused-seen").addEventListener("click", () => { $("refused").hidden = true; });
$("fit").addEventListener("click", fit);
$("zoom-in").addEventListener("click", () => zoom(1.5));
$("zoom-out").addEventListener("click", () => zoom(1 / 1.5));
chart.addEventListener("keydown", (event) => {
  const keys = {
    ArrowLeft: () => pan(60, 0), ArrowRight: () => pan(-60, 0), ArrowUp: () => pan(0, 60), ArrowDown: () => pan(0, -60),
    "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), 0: fit,
    Enter: () => event.target.dataset.id && choose(event.target.dataset.id),
    " ": () => event.target.dataset.id && choose(event.target.dataset.id),
  };
  if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});
new ResizeObserver(draw).observe(chart);

setInterval(tick, 1000);
tick();
connect();
