// The ground under the map: raster tiles when the station was given some, else nothing.

import { svg } from "./dom.js";
import { tileLat, tileLon, tileX, tileY } from "./geo.js";

const MOST = 64; // tiles at once
let source = null; // { tiles: template, attribution, max_zoom }

export async function load() {
  const answer = await fetch("/map.json");
  source = answer.ok ? await answer.json() : null;
}

export const attribution = () => source?.attribution ?? "";

function url(zoom, x, y) {
  const column = ((x % 2 ** zoom) + 2 ** zoom) % 2 ** zoom;
  return source.tiles.replace("{z}", zoom).replace("{x}", column).replace("{y}", y);
}

/** A group of tiles that covers the view; each is put where its own corners are. */
export function tiles(plane, place, fromScreen, { w, h }, scale) {
  const group = svg("g", { class: "tiles", "aria-hidden": "true" });
  if (!source) return group;
  const metresPerPixel = 1 / scale, around = 40075017 * Math.cos((plane.lat * Math.PI) / 180);
  const wanted = Math.round(Math.log2(around / 256 / metresPerPixel));
  const zoom = Math.min(Math.max(wanted, 0), source.max_zoom);
  const [west, south] = plane.lonLat(fromScreen(0, h)), [east, north] = plane.lonLat(fromScreen(w, 0));
  const [x0, x1] = [Math.floor(tileX(west, zoom)), Math.floor(tileX(east, zoom))];
  const last = 2 ** zoom - 1, row = (lat) => Math.min(Math.max(Math.floor(tileY(lat, zoom)), 0), last);
  const [y0, y1] = [row(Math.min(north, 85)), row(Math.max(south, -85))];
  if ((x1 - x0 + 1) * (y1 - y0 + 1) > MOST) return group;
  for (let x = x0; x <= x1; x += 1) for (let y = y0; y <= y1; y += 1) group.append(tile(place, zoom, x, y));
  return group;
}

function tile(place, zoom, x, y) {
  const [left, top] = place([tileLon(x, zoom), tileLat(y, zoom)]);
  const [right, bottom] = place([tileLon(x + 1, zoom), tileLat(y + 1, zoom)]);
  // Half a pixel over the edge, so that no seam shows.
  return svg("image", { href: url(zoom, x, y), x: left, y: top, width: right - left + 0.5, height: bottom - top + 0.5, preserveAspectRatio: "none" });
}
