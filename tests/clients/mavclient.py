"""What the MAVLink clients share: a UDP link, a schedule, and a book of what arrived."""

import os

os.environ["MAVLINK20"] = "1"  # before pymavlink is imported: it chooses the wire format then

import json
import signal
import sys
import time
from collections import defaultdict

from pymavlink import mavutil

DIALECT = "development"
mavutil.set_dialect(DIALECT)
mavlink = mavutil.mavlink


class UdpLink:
    """One UDP end that speaks as `system`/`component`.

    With `send_to` it sends there from a port of its own, as an autopilot does to its companion; with
    `bind` it waits for the first datagram and answers its sender, as a ground station does.
    """

    def __init__(self, system, component, send_to=None, bind=None):
        url = f"udpout:{send_to}" if send_to else f"udpin:{bind}"
        self._connection = mavutil.mavlink_connection(
            url, source_system=system, source_component=component, dialect=DIALECT
        )
        self.mav = self._connection.mav
        self._waits_for_peer = send_to is None

    def sign(self, secret, link_id, newest=None):
        """Signs what it sends, and takes nothing that is not signed with the same secret.

        `newest` of a stream (link id, system, component) is the latest time that was seen of it before.
        """
        self._connection.setup_signing(secret, sign_outgoing=True, link_id=link_id)
        self.mav.signing.stream_timestamps.update(newest or {})

    def signatures(self):
        """What pymavlink counted, and each stream's latest time."""
        signing = self.mav.signing
        return {
            "good": signing.goodsig_count,
            "bad": signing.badsig_count,
            "unsigned": signing.unsigned_count,
            "rejected": signing.reject_count,
            "newest": {"/".join(map(str, stream)): at for stream, at in signing.stream_timestamps.items()},
        }

    @property
    def port(self):
        return self._connection.port.getsockname()[1]

    @property
    def has_peer(self):
        return not self._waits_for_peer or bool(self._connection.clients)

    def write(self, data):
        """Sends bytes as they are."""
        if self.has_peer:
            self._connection.write(data)

    def send(self, message, system=None, component=None):
        """Sends a message, by default as the link's own system and component."""
        if not self.has_peer:
            return
        own = self.mav.srcSystem, self.mav.srcComponent
        self.mav.srcSystem = own[0] if system is None else system
        self.mav.srcComponent = own[1] if component is None else component
        self.mav.send(message)
        self.mav.srcSystem, self.mav.srcComponent = own

    def receive(self):
        """All messages that wait, in order; unreadable bytes come as BAD_DATA."""
        while (message := self._connection.recv_msg()) is not None:
            yield message


class Schedule:
    """Calls functions at given rates; `interval_s` of None is off."""

    def __init__(self):
        self._interval = {}
        self._due = {}

    def set(self, name, interval_s):
        self._interval[name] = interval_s
        self._due[name] = time.monotonic()

    def due(self):
        now = time.monotonic()
        for name, interval in self._interval.items():
            if interval is not None and now >= self._due[name]:
                # Skip what was missed instead of sending it in a burst.
                self._due[name] = max(self._due[name] + interval, now - interval)
                yield name


class Book:
    """Counts every message by sender and keeps those that the tests ask about."""

    KEPT = {
        "STATUSTEXT": "statustexts",
        "CAMERA_TRACKING_GEO_STATUS": "geo_statuses",
        "COMMAND_INT": "command_ints",
        "COMMAND_LONG": "command_longs",
        "COMMAND_ACK": "command_acks",
        "ADSB_VEHICLE": "traffic",
    }

    def __init__(self):
        self.started = time.monotonic()
        self.counts = defaultdict(lambda: defaultdict(int))
        self.heartbeats = {}
        self.bad_data = 0
        self.kept = {name: [] for name in self.KEPT.values()}

    def add(self, message):
        kind = message.get_type()
        if kind == "BAD_DATA":
            self.bad_data += 1
            return
        sender = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
        self.counts[sender][kind] += 1
        if kind == "HEARTBEAT":
            self._add_heartbeat(sender, message)
        elif kind in self.KEPT:
            self._keep(sender, message)

    def _add_heartbeat(self, sender, message):
        now = round(time.monotonic() - self.started, 3)
        entry = self.heartbeats.setdefault(sender, {"count": 0, "first_s": now, "longest_gap_s": 0.0})
        if entry["count"]:
            entry["longest_gap_s"] = round(max(entry["longest_gap_s"], now - entry["last_s"]), 3)
        entry["count"] += 1
        entry["last_s"] = now
        entry["type"] = message.type
        entry["autopilot"] = message.autopilot
        entry["system_status"] = message.system_status

    def _keep(self, sender, message):
        fields = {k: plain(v) for k, v in message.to_dict().items() if k != "mavpackettype"}
        fields["from"] = sender
        fields["at_s"] = round(time.monotonic() - self.started, 3)
        fields["signed"] = bool(message.get_signed())
        self.kept[self.KEPT[message.get_type()]].append(fields)

    def summary(self):
        return {
            "seconds": round(time.monotonic() - self.started, 3),
            "heartbeats": self.heartbeats,
            "counts": self.counts,
            "bad_data": self.bad_data,
            **self.kept,
        }


def secret(text):
    """32 bytes from a file of 64 hexadecimal digits."""
    with open(text, encoding="ascii") as file:
        return bytes.fromhex(file.read().strip())


def plain(value):
    """JSON has no NaN and no bytes."""
    if isinstance(value, float) and value != value:
        return None
    if isinstance(value, (bytes, bytearray)):
        return value.hex()
    return value


class Clock:
    """True until the time is over or somebody asks to end; a summary is due in both cases."""

    def __init__(self, seconds):
        self._end = time.monotonic() + seconds
        self._stopped = False
        for name in (signal.SIGTERM, signal.SIGINT):
            signal.signal(name, lambda *_: self.stop())

    def stop(self):
        self._stopped = True

    def runs(self):
        return not self._stopped and time.monotonic() < self._end


def say_ready(**facts):
    """Tells whoever started us, on stderr, that the sockets are open."""
    print("ready " + json.dumps(facts), file=sys.stderr, flush=True)


def print_json(value):
    json.dump(value, sys.stdout, indent=2)
    print(flush=True)
