// What the page knows. Everything else draws it.

export const known = {
  store: null, // name of the ground's store; another one means: forget everything
  incidents: new Map(), // incident id -> GeoJSON Feature
  details: new Map(), // incident id -> { row, alarms: newest Feature of each alarm, history }
  aircraft: new Map(), // name -> { points: [[lon, lat, h]..], latest }
  chosen: null,
  showsDismissed: false,
  clockAhead: 0, // ms that the ground's clock is ahead of this browser's
  heardAt: 0, // when anything last came, by this browser's clock
  lost: false,
  role: null, // what the station lets this browser do: "operator" or "screen"
};

const MAX_POINTS = 3600;
/** An aircraft, or the ground, that says nothing for so long is silent, ms. */
export const SILENT_MS = 12000;

export const now = () => Date.now() + known.clockAhead;
export const isOut = (p) => p.state === "out";
export const isDismissed = (p) => p.operator.state === "dismissed";
export const isOpen = (p) => !isOut(p) && !isDismissed(p);
/** Somebody has to look at it. */
export const isNew = (p) => isOpen(p) && p.operator.state === "new" && p.state !== "suspected";
export const chosen = () => known.incidents.get(known.chosen);
export const isSilent = (craft) => now() - Date.parse(craft.latest.at) > SILENT_MS;

export function forgetAll() {
  for (const map of [known.incidents, known.details, known.aircraft]) map.clear();
  known.store = known.chosen = null;
}

/** Returns what it was before, if it was known; `undefined` if the news is old. */
export function takeIncident(feature) {
  const { id } = feature, before = known.incidents.get(id);
  if (before && before.properties.row > feature.properties.row) return { old: true };
  known.incidents.set(id, feature);
  return { before: before?.properties };
}

export function takeGone({ id, into }) {
  known.incidents.delete(id);
  known.details.delete(id);
  if (known.chosen === id) known.chosen = into;
}

export function takePosition(ping) {
  const craft = known.aircraft.get(ping.uav) ?? { points: [], latest: null };
  if (craft.latest && ping.at < craft.latest.at) return;
  craft.latest = ping;
  craft.points.push([ping.longitude_deg, ping.latitude_deg, ping.height_ellipsoid_m]);
  if (craft.points.length > MAX_POINTS) craft.points.shift();
  known.aircraft.set(ping.uav, craft);
}

export function takeTracks(collection) {
  for (const { geometry, properties } of collection.features) {
    const points = geometry.type === "Point" ? [geometry.coordinates] : geometry.coordinates;
    const craft = known.aircraft.get(properties.uav);
    const newer = craft?.latest && craft.latest.at > properties.at ? craft.latest : properties;
    known.aircraft.set(properties.uav, { points, latest: newer });
  }
}

// What wants attention first; within a group by name: an entry does not jump with every sighting.
function group(p) {
  if (isDismissed(p)) return 5;
  if (isOut(p)) return 4;
  if (p.state === "suspected" && p.operator.state === "new") return 3;
  return { new: 0, acknowledged: 2, confirmed: 1 }[p.operator.state] ?? 3;
}

export function sorted() {
  return [...known.incidents.values()]
    .filter((f) => known.showsDismissed || !isDismissed(f.properties) || f.id === known.chosen)
    .sort((a, b) => group(a.properties) - group(b.properties)
      || a.id.localeCompare(b.id, "en", { numeric: true }));
}

/** The newest alarm of an incident in full, once it was fetched. */
export function newestAlarm(id) {
  const alarms = known.details.get(id)?.alarms ?? [];
  return alarms.reduce((best, f) => (!best || f.properties.captured_at > best.properties.captured_at ? f : best), null);
}
