// Coordinates as people read them out: decimal, degrees-minutes-seconds, UTM and MGRS. Pure: the tests
// run this file outside of a browser, against other programs.

/** Six decimals are a tenth of a metre. */
export function decimal(lat, lon) {
  return `${lat.toFixed(6)}, ${lon.toFixed(6)}`;
}

export function dms(lat, lon) {
  return `${sexagesimal(lat, "N", "S", 2)} ${sexagesimal(lon, "E", "W", 2)}`;
}

/** One angle; in units of the last digit first, so that 59.999 never prints as 60.00. */
export function sexagesimal(value, positive, negative, digits) {
  const units = 10 ** digits;
  const total = Math.round(Math.abs(value) * 3600 * units);
  const degrees = Math.floor(total / (3600 * units));
  const minutes = Math.floor(total / (60 * units)) % 60;
  const seconds = ((total % (60 * units)) / units).toFixed(digits).padStart(digits ? 3 + digits : 2, "0");
  return `${degrees}°${String(minutes).padStart(2, "0")}′${seconds}″${value < 0 ? negative : positive}`;
}

const A = 6378137, F = 1 / 298.257223563, N = F / (2 - F), K0 = 0.9996;
// Krüger's series to the sixth order (Karney 2011, "Transverse Mercator with an accuracy of a few
// nanometers", eq. 14 and 35): rectifying radius, and the coefficients of conformal to rectifying latitude.
const RADIUS = (A / (1 + N)) * (1 + N ** 2 / 4 + N ** 4 / 64 + N ** 6 / 256);
const ALPHA = [
  N / 2 - (2 * N ** 2) / 3 + (5 * N ** 3) / 16 + (41 * N ** 4) / 180 - (127 * N ** 5) / 288 + (7891 * N ** 6) / 37800,
  (13 * N ** 2) / 48 - (3 * N ** 3) / 5 + (557 * N ** 4) / 1440 + (281 * N ** 5) / 630 - (1983433 * N ** 6) / 1935360,
  (61 * N ** 3) / 240 - (103 * N ** 4) / 140 + (15061 * N ** 5) / 26880 + (167603 * N ** 6) / 181440,
  (49561 * N ** 4) / 161280 - (179 * N ** 5) / 168 + (6601661 * N ** 6) / 7257600,
  (34729 * N ** 5) / 80640 - (3418889 * N ** 6) / 1995840,
  (212378941 * N ** 6) / 319334400,
];
const ECCENTRICITY = Math.sqrt(F * (2 - F));

/** Zone, with the exceptions of Norway and Svalbard. */
export function utmZone(lat, lon) {
  const east = ((((lon + 180) % 360) + 360) % 360) - 180;
  if (lat >= 56 && lat < 64 && east >= 3 && east < 12) return 32;
  if (lat >= 72 && lat < 84 && east >= 0 && east < 42) return [31, 33, 35, 37][[9, 21, 33, 42].findIndex((edge) => east < edge)];
  return Math.floor((east + 180) / 6) + 1;
}

/** Easting and northing in metres; null near the poles, where there is no UTM. */
export function utmOf(lat, lon) {
  if (!(lat >= -80 && lat < 84)) return null;
  const zone = utmZone(lat, lon), middle = zone * 6 - 183, rad = Math.PI / 180;
  const phi = lat * rad, lambda = (((((lon - middle + 180) % 360) + 360) % 360) - 180) * rad;
  // Conformal latitude by its tangent, then the sphere, then the series.
  const tau = Math.tan(phi), sigma = Math.sinh(ECCENTRICITY * Math.atanh(ECCENTRICITY * Math.sin(phi)));
  const conformal = tau * Math.hypot(1, sigma) - sigma * Math.hypot(1, tau);
  const xi = Math.atan2(conformal, Math.cos(lambda));
  const eta = Math.asinh(Math.sin(lambda) / Math.hypot(conformal, Math.cos(lambda)));
  const series = (own, other) => ALPHA.reduce((sum, alpha, k) => sum + alpha * own(2 * (k + 1)) * other(2 * (k + 1)), 0);
  const north = xi + series((j) => Math.sin(j * xi), (j) => Math.cosh(j * eta));
  const east = eta + series((j) => Math.cos(j * xi), (j) => Math.sinh(j * eta));
  return {
    zone, band: "CDEFGHJKLMNPQRSTUVWXX"[Math.floor((lat + 80) / 8)],
    easting: 500000 + K0 * RADIUS * east,
    northing: K0 * RADIUS * north + (lat < 0 ? 10000000 : 0),
  };
}

export function utm(lat, lon) {
  const place = utmOf(lat, lon);
  if (!place) return null;
  return `${place.zone}${place.band} ${Math.round(place.easting)} ${Math.round(place.northing)}`;
}

/** To the metre, which is cut off, not rounded: a square is named by its south-west corner. */
export function mgrs(lat, lon) {
  const place = utmOf(lat, lon);
  if (!place) return null;
  // 1e-6 m keeps a corner that is one in its own square when the last bit is short.
  const easting = Math.floor(place.easting + 1e-6), northing = Math.floor(place.northing + 1e-6);
  const columns = ["STUVWXYZ", "ABCDEFGH", "JKLMNPQR"][place.zone % 3];
  const rows = "ABCDEFGHJKLMNPQRSTUV", shift = place.zone % 2 ? 0 : 5;
  const column = columns[Math.floor(easting / 100000) - 1];
  const row = rows[(Math.floor(northing / 100000) + shift) % 20];
  const five = (metres) => String(metres % 100000).padStart(5, "0");
  return `${String(place.zone).padStart(2, "0")}${place.band} ${column}${row} ${five(easting)} ${five(northing)}`;
}
