#!/usr/bin/env python3
"""What a .tlog holds, read by pymavlink: counts, rates, gaps and the track, as JSON.

Rates are counts over the length of the whole log. Gaps longer than --gap-s are listed for the whole
stream, and counted for each kind of message of the vehicle.
"""

import argparse
import math
import os

os.environ["MAVLINK20"] = "1"

from collections import Counter, defaultdict

from mavclient import mavutil, print_json
from pyproj import Geod


class Stream:
    """Arrival times of one kind of message: count, and gaps."""

    def __init__(self, limit_s):
        self.limit_s = limit_s
        self.count = 0
        self.first = self.last = None
        self.longest_s = 0.0
        self.gaps = []

    def add(self, at):
        if self.last is None:
            self.first = at
        else:
            gap = at - self.last
            self.longest_s = max(self.longest_s, gap)
            if gap > self.limit_s:
                self.gaps.append({"after_s": round(self.last - self.first, 6), "length_s": round(gap, 6)})
        self.last = at
        self.count += 1


class Track:
    """Extremes and length of a line of positions; (0, 0) is no position."""

    def __init__(self):
        self.points = 0
        self.refused = 0
        self.low = [math.inf] * 3
        self.high = [-math.inf] * 3
        self.length_m = 0.0
        self.last = None
        self.geod = Geod(ellps="WGS84")

    def add(self, lat, lon, alt):
        if lat == 0 and lon == 0:
            self.refused += 1
            return
        here = (lat, lon, alt)
        self.low = [min(a, b) for a, b in zip(self.low, here, strict=True)]
        self.high = [max(a, b) for a, b in zip(self.high, here, strict=True)]
        if self.last:
            self.length_m += self.geod.inv(self.last[1], self.last[0], lon, lat)[2]
        self.last = here
        self.points += 1

    def summary(self):
        facts = {"points": self.points, "zero_positions": self.refused}
        if self.points:
            names = ("lat_deg", "lon_deg", "alt_msl_m")
            facts["min"] = dict(zip(names, self.low, strict=True))
            facts["max"] = dict(zip(names, self.high, strict=True))
            facts["length_m"] = round(self.length_m, 3)
        return facts


def read(path, dialect):
    log = mavutil.mavlink_connection(path, dialect=dialect)
    while (message := log.recv_msg()) is not None:
        yield message


def summarize(path, dialect, gap_s):
    everything = Stream(gap_s)
    kinds = defaultdict(lambda: Stream(gap_s))
    senders = defaultdict(Counter)
    fixes = Counter()
    estimate, gnss = Track(), Track()
    bad_bytes = unknown = 0
    for message in read(path, dialect):
        kind = message.get_type()
        if kind == "BAD_DATA":
            bad_bytes += len(message.data)
            continue
        if kind.startswith("UNKNOWN_"):
            unknown += 1
        everything.add(message._timestamp)
        kinds[kind].add(message._timestamp)
        senders[f"{message.get_srcSystem()}/{message.get_srcComponent()}"][kind] += 1
        if kind == "GLOBAL_POSITION_INT":
            estimate.add(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)
        elif kind == "GPS_RAW_INT":
            fixes[message.fix_type] += 1
            gnss.add(message.lat / 1e7, message.lon / 1e7, message.alt / 1e3)
    length = everything.last - everything.first if everything.count else 0.0
    return {
        "frames": everything.count,
        "unknown_frames": unknown,
        "bad_bytes": bad_bytes,
        "first_utc_s": everything.first,
        "last_utc_s": everything.last,
        "length_s": round(length, 6),
        "gaps": everything.gaps,
        "messages": {
            kind: {
                "count": stream.count,
                "rate_hz": round(stream.count / length, 4) if length else None,
                "gaps": len(stream.gaps),
                "longest_gap_s": round(stream.longest_s, 6),
            }
            for kind, stream in sorted(kinds.items())
        },
        "senders": senders,
        "gnss_fix_types": fixes,
        "track": {"GLOBAL_POSITION_INT": estimate.summary(), "GPS_RAW_INT": gnss.summary()},
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file")
    parser.add_argument("--dialect", default="ardupilotmega", help="development shows what emberfix knows")
    parser.add_argument("--gap-s", type=float, default=1.0)
    args = parser.parse_args()
    print_json(summarize(args.file, args.dialect, args.gap_s))


if __name__ == "__main__":
    main()
