#!/usr/bin/env python3
"""Geodesy by PROJ: one JSON request a line on stdin, one answer a line on stdout.

WGS84; degrees and metres; heights above the ellipsoid; ENU at an origin `lat0`, `lon0`, `h0`.

  {"op": "lla_to_ecef", "lat": .., "lon": .., "h": ..}             -> x, y, z
  {"op": "ecef_to_lla", "x": .., "y": .., "z": ..}                 -> lat, lon, h
  {"op": "lla_to_enu", "lat0": .., "lon0": .., "h0": .., "lat": .., "lon": .., "h": ..}  -> e, n, u
  {"op": "enu_to_lla", "lat0": .., "lon0": .., "h0": .., "e": .., "n": .., "u": ..}      -> lat, lon, h
  {"op": "ecef_to_enu", ..., "x", "y", "z"}                        -> e, n, u
  {"op": "enu_to_ecef", ..., "e", "n", "u"}                        -> x, y, z
  {"op": "inverse", "lat1", "lon1", "lat2", "lon2"}                -> azimuth1, azimuth2, distance
  {"op": "direct", "lat1", "lon1", "azimuth1", "distance"}         -> lat2, lon2, azimuth2

`azimuth2` points onward at the second place. A key `id` comes back with the answer; a request that
cannot be answered gives {"error": ..}. --ellipsoid takes another one, GRS80 for instance.
"""

import argparse
import json
import sys
from functools import lru_cache

from pyproj import Geod, Transformer

LLA, ECEF, ENU = ("lat", "lon", "h"), ("x", "y", "z"), ("e", "n", "u")
NAMES = {"lla": LLA, "ecef": ECEF, "enu": ENU}


class Oracle:
    def __init__(self, ellipsoid):
        self.ellipsoid = ellipsoid
        self.geod = Geod(ellps=ellipsoid)
        self.cartesian = Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps={ellipsoid}"
        )

    def answer(self, request):
        op = request["op"]
        if op == "inverse":
            return self.inverse(request)
        if op == "direct":
            return self.direct(request)
        source, target = op.split("_to_")
        values = [float(request[name]) for name in NAMES[source]]
        ecef = self.to_ecef(source, values, request)
        return dict(zip(NAMES[target], self.from_ecef(target, ecef, request), strict=True))

    def to_ecef(self, source, values, request):
        if source == "lla":
            lat, lon, h = values
            return self.cartesian.transform(lon, lat, h)
        if source == "enu":
            return self.topocentric(request).transform(*values, direction="INVERSE")
        return values

    def from_ecef(self, target, ecef, request):
        if target == "lla":
            lon, lat, h = self.cartesian.transform(*ecef, direction="INVERSE")
            return lat, lon, h
        if target == "enu":
            return self.topocentric(request).transform(*ecef)
        return ecef

    def topocentric(self, request):
        return topocentric(self.ellipsoid, *(float(request[name]) for name in ("lat0", "lon0", "h0")))

    def inverse(self, request):
        azimuth1, back, distance = self.geod.inv(
            *(float(request[name]) for name in ("lon1", "lat1", "lon2", "lat2"))
        )
        return {"azimuth1": azimuth1, "azimuth2": onward(back), "distance": distance}

    def direct(self, request):
        lon, lat, back = self.geod.fwd(
            *(float(request[name]) for name in ("lon1", "lat1", "azimuth1", "distance"))
        )
        return {"lat2": lat, "lon2": lon, "azimuth2": onward(back)}


def onward(back_azimuth):
    """PROJ gives the azimuth back to where one came from."""
    azimuth = back_azimuth + 180
    return azimuth - 360 if azimuth > 180 else azimuth


@lru_cache(maxsize=4096)
def topocentric(ellipsoid, lat0, lon0, h0):
    return Transformer.from_pipeline(
        f"+proj=topocentric +ellps={ellipsoid} +lat_0={lat0!r} +lon_0={lon0!r} +h_0={h0!r}"
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ellipsoid", default="WGS84")
    oracle = Oracle(parser.parse_args().ellipsoid)
    for line in sys.stdin:
        if not line.strip():
            continue
        try:
            request = json.loads(line)
            answer = oracle.answer(request)
        except (KeyError, TypeError, ValueError) as error:
            request, answer = {}, {"error": f"{type(error).__name__}: {error}"}
        if "id" in request:
            answer["id"] = request["id"]
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
