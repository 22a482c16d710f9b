#!/usr/bin/env python3
"""An autopilot that behaves on MAVLink the way PX4 does towards its companion, by pymavlink.

It flies a hover or a circle, streams attitude, position, GNSS and time, answers TIMESYNC and
SET_MESSAGE_INTERVAL, may pass frames on to a ground station, and prints as JSON what it received.
"""

import argparse
import math
import random
import struct
import time

from mavclient import Book, Clock, Schedule, UdpLink, mavlink, print_json, say_ready, secret

SYSTEM, COMPONENT = 1, 1
EARTH_RADIUS_M = 6_378_137.0
GRAVITY = 9.80665

# PX4's "onboard" profile, Hz; GPS_RAW_INT comes with every fix of the receiver.
DEFAULT_RATES = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 10,
}


class Flight:
    """Where the vehicle is at a time since take-off: a hover, or a circle with its bank."""

    def __init__(self, args):
        self.lat, self.lon = math.radians(args.lat), math.radians(args.lon)
        self.ellipsoid_m = args.ellipsoid_height_m
        self.home_m = args.ellipsoid_height_m - args.height_m
        self.radius_m, self.speed = args.orbit_radius_m, args.speed_m_s
        self.heading, self.roll, self.pitch = (
            math.radians(a) for a in (args.heading_deg, args.roll_deg, args.pitch_deg)
        )

    def state(self, t):
        """Latitude, longitude (rad), velocity north and east (m/s), roll, pitch, yaw (rad)."""
        if not self.radius_m:
            return self.lat, self.lon, 0.0, 0.0, self.roll, self.pitch, self.heading
        rate = self.speed / self.radius_m
        around = self.heading + rate * t  # clockwise seen from above
        north, east = self.radius_m * math.cos(around), self.radius_m * math.sin(around)
        yaw = (around + math.pi / 2) % (2 * math.pi)
        bank = math.atan2(self.speed**2, self.radius_m * GRAVITY)
        lat = self.lat + north / EARTH_RADIUS_M
        lon = self.lon + east / (EARTH_RADIUS_M * math.cos(self.lat))
        vn, ve = self.speed * math.cos(yaw), self.speed * math.sin(yaw)
        return lat, lon, vn, ve, bank, self.pitch, yaw


def quaternion(roll, pitch, yaw):
    """w, x, y, z of the rotation from FRD body axes to NED, as MAVLink wants it."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


class Autopilot:
    def __init__(self, args):
        self.args = args
        self.flight = Flight(args)
        self.began_ns = time.monotonic_ns()
        self.boot_ns = self.began_ns - int(args.boot_age_s * 1e9)
        self.rebooted = False
        self.companion = UdpLink(SYSTEM, COMPONENT, send_to=f"{args.host}:{args.port}")
        if args.sign:
            newest = {(0, SYSTEM, 191): args.newest_of_companion} if args.newest_of_companion else None
            self.companion.sign(args.sign, 0, newest)
        self.ground = args.ground_port and UdpLink(
            SYSTEM, COMPONENT, send_to=f"{args.host}:{args.ground_port}"
        )
        self.book, self.ground_book = Book(), Book()
        self.schedule = Schedule()
        for message_id, rate in DEFAULT_RATES.items():
            self.schedule.set(message_id, 1 / rate if rate else None)
        self.schedule.set("garbage", 0.05 if args.garbage else None)
        self.random = random.Random(args.seed)
        self.sent = {}
        self.intervals = []
        self.recorded = None
        self.timesync_requests = 0
        self.timesync_replies = []
        self.forwarded = {"to_ground": 0, "to_companion": 0}

    # Clocks ---------------------------------------------------------------------------------------

    def elapsed_s(self):
        return (time.monotonic_ns() - self.began_ns) / 1e9

    def boot_time_ns(self):
        return time.monotonic_ns() - self.boot_ns

    def boot_time_ms(self):
        return self.boot_time_ns() // 1_000_000 & 0xFFFFFFFF

    # The loop -------------------------------------------------------------------------------------

    def run(self):
        clock = Clock(self.args.seconds)
        say_ready(sends_to=self.args.port)
        while clock.runs():
            self.reboot_if_due()
            for due in self.schedule.due():
                self.send_garbage() if due == "garbage" else self.send(due)
            for message in self.companion.receive():
                self.book.add(message)
                self.answer(message)
                self.forward(message, self.ground, "to_ground")
            if self.ground:
                for message in self.ground.receive():
                    self.ground_book.add(message)
                    self.forward(message, self.companion, "to_companion")
            time.sleep(0.001)
        return self.summary()

    def reboot_if_due(self):
        if self.args.reboot_at is not None and not self.rebooted and self.elapsed_s() > self.args.reboot_at:
            self.boot_ns = time.monotonic_ns()
            self.rebooted = True

    # Sending --------------------------------------------------------------------------------------

    def send(self, message_id):
        make = getattr(self, "make_" + mavlink.mavlink_map[message_id].msgname.lower(), None)
        message = make and make()
        if message is None:
            return
        self.companion.send(message)
        if message_id == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            self.recorded = message.get_msgbuf()
        if self.ground:
            self.ground.write(message.get_msgbuf())
        name = message.get_type()
        self.sent[name] = self.sent.get(name, 0) + 1

    def make_heartbeat(self):
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_PX4,
            mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            4 << 16,  # PX4's main mode "auto"
            mavlink.MAV_STATE_ACTIVE,
            3,
        )

    def make_system_time(self):
        return mavlink.MAVLink_system_time_message(time.time_ns() // 1000, self.boot_time_ms())

    def attitude_is_silent(self):
        after = self.args.stale_attitude
        return after is not None and self.elapsed_s() >= after

    def make_attitude(self):
        if self.attitude_is_silent():
            return None
        *_, roll, pitch, yaw = self.flight.state(self.elapsed_s())
        yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
        return mavlink.MAVLink_attitude_message(self.boot_time_ms(), roll, pitch, yaw, 0, 0, 0)

    def make_attitude_quaternion(self):
        if self.attitude_is_silent():
            return None
        q = quaternion(*self.flight.state(self.elapsed_s())[4:])
        if self.args.nan_attitude:
            q = (math.nan,) * 4
        return mavlink.MAVLink_attitude_quaternion_message(self.boot_time_ms(), *q, 0, 0, 0)

    def make_global_position_int(self):
        lat, lon, vn, ve, _, _, yaw = self.flight.state(self.elapsed_s())
        msl = self.flight.ellipsoid_m - self.args.geoid_m
        relative = self.flight.ellipsoid_m - self.flight.home_m
        if self.args.no_gps_fix:
            lat = lon = msl = relative = 0.0
        return mavlink.MAVLink_global_position_int_message(
            self.boot_time_ms(),
            round(math.degrees(lat) * 1e7),
            round(math.degrees(lon) * 1e7),
            round(msl * 1e3),
            round(relative * 1e3),
            round(vn * 100),
            round(ve * 100),
            0,
            round(math.degrees(yaw) % 360 * 100) % 36000,
        )

    def make_gps_raw_int(self):
        boot_us = self.boot_time_ns() // 1000
        if self.args.no_gps_fix:
            none = 0xFFFF
            return mavlink.MAVLink_gps_raw_int_message(
                boot_us, mavlink.GPS_FIX_TYPE_NO_GPS, 0, 0, 0, none, none, none, none, 255
            )
        lat, lon, vn, ve, *_ = self.flight.state(self.elapsed_s())
        course = math.degrees(math.atan2(ve, vn)) % 360
        height = self.flight.ellipsoid_m
        return mavlink.MAVLink_gps_raw_int_message(
            boot_us,
            mavlink.GPS_FIX_TYPE_3D_FIX,
            round(math.degrees(lat) * 1e7),
            round(math.degrees(lon) * 1e7),
            round((height - self.args.geoid_m) * 1e3),
            80,
            120,
            round(math.hypot(vn, ve) * 100),
            round(course * 100),
            14,
            alt_ellipsoid=0 if self.args.no_ellipsoid_height else round(height * 1e3),
            h_acc=1200,
            v_acc=2000,
            vel_acc=200,
            hdg_acc=0,
            yaw=0,
        )

    def make_estimator_status(self):
        flags = 0 if self.args.no_gps_fix else 0x33F  # attitude to absolute position, no glitch
        return mavlink.MAVLink_estimator_status_message(
            self.boot_time_ns() // 1000, flags, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.5, 0.8
        )

    def make_timesync(self):
        """PX4's own request: it wants the companion's clock too."""
        return mavlink.MAVLink_timesync_message(0, self.boot_time_ns())

    def send_garbage(self):
        """In turn: noise, a frame with a wrong checksum, half a frame, a message that nobody knows."""
        noise = self.random.randbytes(self.random.randint(1, 300))
        attitude = mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0).pack(self.companion.mav)
        wrong = attitude[:-1] + bytes([attitude[-1] ^ 0xFF])
        unknown = b"\xfd" + struct.pack("<BBBBBB", 4, 0, 0, 0, SYSTEM, COMPONENT) + b"\xef\xbe\xad" + bytes(6)
        self.companion.write(self.random.choice([noise, wrong, attitude[: len(attitude) // 2], unknown]))
        self.sent["garbage"] = self.sent.get("garbage", 0) + 1

    # Answering ------------------------------------------------------------------------------------

    def answer(self, message):
        kind = message.get_type()
        if kind == "TIMESYNC":
            self.answer_timesync(message)
        elif kind in ("COMMAND_LONG", "COMMAND_INT") and self.is_for_me(message):
            self.answer_command(message)

    @staticmethod
    def is_for_me(message):
        return message.target_system in (0, SYSTEM) and message.target_component in (0, COMPONENT)

    def answer_timesync(self, message):
        if message.tc1 != 0:
            self.timesync_replies.append({"tc1": message.tc1, "ts1": message.ts1})
            return
        self.timesync_requests += 1
        if not self.args.no_timesync:
            self.companion.send(mavlink.MAVLink_timesync_message(self.boot_time_ns(), message.ts1))

    def answer_command(self, message):
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self.set_interval(int(message.param1), message.param2)
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            result = mavlink.MAV_RESULT_ACCEPTED
            self.send(int(message.param1))
        else:
            result = mavlink.MAV_RESULT_UNSUPPORTED
        self.companion.send(
            mavlink.MAVLink_command_ack_message(
                message.command,
                result,
                0,
                0,
                target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            )
        )

    def set_interval(self, message_id, interval_us):
        known = message_id in DEFAULT_RATES
        if self.args.refuse_intervals:
            result = mavlink.MAV_RESULT_DENIED
        else:
            result = mavlink.MAV_RESULT_ACCEPTED if known else mavlink.MAV_RESULT_UNSUPPORTED
        if result == mavlink.MAV_RESULT_ACCEPTED:
            default = DEFAULT_RATES[message_id]
            interval = interval_us / 1e6
            if interval_us == 0:
                interval = 1 / default if default else None
            self.schedule.set(message_id, None if interval_us < 0 else interval)
        self.intervals.append({"id": message_id, "interval_us": interval_us, "result": result})
        return result

    def forward(self, message, link, count):
        """Passes on what is not for the autopilot alone, as PX4 does with MAV_n_FORWARD=1."""
        if not link or message.get_type() == "BAD_DATA":
            return
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if target == (SYSTEM, COMPONENT):
            return
        link.write(message.get_msgbuf())
        self.forwarded[count] += 1

    def summary(self):
        return {
            **self.book.summary(),
            "sent": self.sent,
            "message_intervals": self.intervals,
            "timesync": {
                "requests_received": self.timesync_requests,
                "replies_received": len(self.timesync_replies),
                "last_replies": self.timesync_replies[-3:],
            },
            "forwarded": self.forwarded,
            "signatures": self.companion.signatures() if self.args.sign else None,
            "last_attitude": self.recorded and bytes(self.recorded).hex(),
            "ground": self.ground_book.summary() if self.ground else None,
        }


def arguments():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--host", default="127.0.0.1")
    add("--port", type=int, required=True, help="UDP port where the companion listens")
    add(
        "--ground-port",
        type=int,
        help="UDP port where a ground station listens; frames are passed on both ways",
    )
    add("--seconds", type=float, default=10.0, help="how long; SIGTERM ends it sooner, with its summary")
    add("--seed", type=int, default=1)
    add("--sign", type=secret, metavar="FILE", help="sign towards the companion, with the secret in FILE")
    add("--newest-of-companion", type=int, metavar="TIME", help="of its signatures that were seen before")

    flight = parser.add_argument_group("flight")
    add = flight.add_argument
    add("--lat", type=float, default=31.409422, help="degrees; the centre of the circle")
    add("--lon", type=float, default=119.112017)
    add("--ellipsoid-height-m", type=float, default=27.0)
    add("--height-m", type=float, default=12.0, help="above home")
    add("--geoid-m", type=float, default=5.0, help="geoid above ellipsoid: what the MSL altitudes lack")
    add("--heading-deg", type=float, default=0.0, help="in a circle: where on it to begin")
    add("--roll-deg", type=float, default=0.0)
    add("--pitch-deg", type=float, default=0.0)
    add("--orbit-radius-m", type=float, default=0.0, help="0 hovers")
    add("--speed-m-s", type=float, default=8.0, help="along the circle")
    add("--boot-age-s", type=float, default=100.0, help="how long ago the autopilot booted")

    fault = parser.add_argument_group("faults")
    add = fault.add_argument
    add("--no-gps-fix", action="store_true", help="fix type 0 and zero positions")
    add("--no-ellipsoid-height", action="store_true", help="GPS_RAW_INT.alt_ellipsoid stays 0")
    add("--stale-attitude", type=float, nargs="?", const=2.0, metavar="AFTER_S", help="attitude falls silent")
    add("--nan-attitude", action="store_true")
    add("--no-timesync", action="store_true", help="never answers TIMESYNC")
    add("--refuse-intervals", action="store_true", help="denies SET_MESSAGE_INTERVAL")
    add("--reboot-at", type=float, metavar="S", help="the boot clock starts anew")
    add("--garbage", action="store_true", help="noise, wrong checksums, half frames, unknown messages")
    return parser.parse_args()


if __name__ == "__main__":
    print_json(Autopilot(arguments()).run())
