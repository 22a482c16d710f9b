#!/usr/bin/env python3
"""A ground station on MAVLink over UDP, by pymavlink; prints as JSON what it received.

It heartbeats as a stock station (255/190). With --ack-as it is our ground agent too, and acknowledges
the alarms that come as COMMAND_INT MAV_CMD_SPATIAL_USER_1.
"""

import argparse
import time

from mavclient import Book, Clock, Schedule, UdpLink, mavlink, print_json, say_ready, secret

STATION = (255, 190)


def identity(text):
    system, component = text.split("/")
    return int(system), int(component)


class Ground:
    def __init__(self, args):
        self.args = args
        where = {"send_to": args.connect} if args.connect else {"bind": f"127.0.0.1:{args.port}"}
        self.link = UdpLink(*STATION, **where)
        if args.sign:
            self.link.sign(args.sign, 2)
        self.book = Book()
        self.acknowledged = []
        self.ignored = 0
        self.schedule = Schedule()
        self.schedule.set("heartbeat", 1.0)
        if args.request_geo_status_hz:
            self.schedule.set("request", 2.0)

    def run(self):
        clock = Clock(self.args.seconds)
        say_ready(port=self.link.port)
        while clock.runs() and not self.has_all():
            for due in self.schedule.due():
                self.send_heartbeats() if due == "heartbeat" else self.request_geo_status()
            for message in self.link.receive():
                self.book.add(message)
                if message.get_type() == "COMMAND_INT":
                    self.acknowledge(message)
            time.sleep(0.002)
        return {**self.book.summary(), "acknowledged": self.acknowledged, "ignored": self.ignored}

    def has_all(self):
        until = self.args.until
        return bool(until) and all(self.book.kept[name] for name in until)

    def send_heartbeats(self):
        kind, autopilot = mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID
        if self.args.as_autopilot:
            kind, autopilot = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4
        heartbeat = mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
        self.link.send(heartbeat)
        if self.args.ack_as:
            self.link.send(heartbeat, *self.args.ack_as)

    def request_geo_status(self):
        """Asks component 191 of the first vehicle for CAMERA_TRACKING_GEO_STATUS."""
        self.link.send(
            mavlink.MAVLink_command_long_message(
                self.args.vehicle,
                191,
                mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                0,
                mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_GEO_STATUS,
                1e6 / self.args.request_geo_status_hz,
                0,
                0,
                0,
                0,
                0,
            )
        )

    def acknowledge(self, command):
        mine = (command.target_system, command.target_component) == self.args.ack_as
        if not mine or command.command != mavlink.MAV_CMD_SPATIAL_USER_1:
            return
        if self.ignored < self.args.ignore_first:
            self.ignored += 1
            return
        alarm = int(command.param1)
        self.link.send(
            mavlink.MAVLink_command_ack_message(
                command.command,
                mavlink.MAV_RESULT_ACCEPTED,
                progress=255,
                result_param2=alarm,
                target_system=command.get_srcSystem(),
                target_component=command.get_srcComponent(),
            ),
            *self.args.ack_as,
        )
        self.acknowledged.append(alarm)


def arguments():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add(
        "--port",
        type=int,
        default=14550,
        help="UDP port to listen at; 0 takes a free one and says it on stderr",
    )
    add("--connect", metavar="HOST:PORT", help="send there first, instead of listening")
    add("--seconds", type=float, default=10.0, help="how long; SIGTERM ends it sooner, with its summary")
    add("--ack-as", type=identity, metavar="SYSTEM/COMPONENT", help="e.g. 254/191: acknowledge alarms to it")
    add("--as-autopilot", action="store_true", help="claim to be one: what must never be sent markers")
    add("--ignore-first", type=int, default=0, metavar="N", help="leave the first N alarms unanswered")
    add(
        "--sign", type=secret, metavar="FILE", help="sign, with the secret in FILE, and take nothing unsigned"
    )
    add("--vehicle", type=int, default=1, help="system id to ask for messages")
    add("--request-geo-status-hz", type=float, default=0.0, metavar="HZ")
    add(
        "--until",
        action="append",
        choices=sorted(Book.KEPT.values()),
        help="end as soon as there is one of each",
    )
    return parser.parse_args()


if __name__ == "__main__":
    print_json(Ground(arguments()).run())
