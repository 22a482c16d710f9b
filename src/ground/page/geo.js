// Geometry of the map. Pure.

const RAD = Math.PI / 180;

/** The same direction from -180 to 180 degrees. */
export const turned = (lon) => ((((lon + 180) % 360) + 360) % 360) - 180;

// Metres east and north of an origin in its tangent plane (radii of curvature of WGS84). Good to a few
// parts in a thousand within 50 km, which is for drawing only: coordinates in words are the alarm's own.
export class Plane {
  constructor([lon, lat]) {
    const e2 = 0.00669437999014, a = 6378137, w2 = 1 - e2 * Math.sin(lat * RAD) ** 2;
    Object.assign(this, { lon, lat });
    this.east = (a / Math.sqrt(w2)) * Math.cos(lat * RAD) * RAD;
    this.north = ((a * (1 - e2)) / w2 ** 1.5) * RAD;
  }

  xy([lon, lat]) {
    return [turned(lon - this.lon) * this.east, (lat - this.lat) * this.north];
  }

  lonLat([x, y]) {
    return [this.lon + x / this.east, this.lat + y / this.north];
  }
}

/** Half-axes in metres and the larger one's direction, from east towards north, of the ellipse that holds 90 %. */
export function ellipse(c) {
  const [a, b, d] = [c[0], (c[1] + c[3]) / 2, c[4]];
  const mean = (a + d) / 2, half = Math.hypot((a - d) / 2, b), k = Math.sqrt(-2 * Math.log(0.1));
  return {
    major: k * Math.sqrt(Math.max(0, mean + half)), minor: k * Math.sqrt(Math.max(0, mean - half)),
    degrees: (0.5 * Math.atan2(2 * b, a - d)) / RAD,
  };
}

/** The longest of 1, 2, 5 times a power of ten that is at most `most`. */
export function roundLength(most) {
  const ten = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].map((n) => n * ten).find((n) => n <= most) ?? ten;
}

// Steps of a graticule: parts of a second, seconds, minutes, degrees.
const STEPS = [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 18000, 36000]
  .map((seconds) => seconds / 3600);

/** The smallest step that is at least so many degrees. */
export const graticuleStep = (least) => STEPS.find((step) => step >= least) ?? STEPS.at(-1);

/** Web Mercator: column and row of a place as fractions, and back. */
export const tileX = (lon, zoom) => ((lon + 180) / 360) * 2 ** zoom;
export const tileY = (lat, zoom) => (0.5 - Math.asinh(Math.tan(lat * RAD)) / (2 * Math.PI)) * 2 ** zoom;
export const tileLon = (x, zoom) => (x / 2 ** zoom) * 360 - 180;
export const tileLat = (y, zoom) => Math.atan(Math.sinh((0.5 - y / 2 ** zoom) * 2 * Math.PI)) / RAD;
