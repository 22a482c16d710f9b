"""The MAVLink clients against each other, over real sockets."""

import math
import time

import pytest
from conftest import finish, ready, run, start
from mav_autopilot import quaternion
from mavclient import Book, Schedule, UdpLink, mavlink


class Companion:
    """A stand-in for our service at a free port."""

    def __init__(self):
        self.link = UdpLink(1, 191, bind="127.0.0.1:0")
        self.book = Book()
        self.replies = []

    def talk(self, seconds, jobs):
        """Calls each of `jobs`, {interval: function}, while it listens."""
        schedule = Schedule()
        for interval in jobs:
            schedule.set(interval, interval)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for interval in schedule.due():
                jobs[interval]()
            for message in self.link.receive():
                self.book.add(message)
                if message.get_type() == "TIMESYNC" and message.tc1:
                    self.replies.append((time.monotonic_ns(), message.tc1, message.ts1))
            time.sleep(0.002)

    def ask_attitude(self):
        command, attitude = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE
        self.link.send(
            mavlink.MAVLink_command_long_message(1, 1, command, 0, attitude, 20_000, 0, 0, 0, 0, 0)
        )

    def sync(self):
        self.link.send(mavlink.MAVLink_timesync_message(0, time.monotonic_ns()))

    def alarm(self):
        self.link.send(mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_ALERT, b"FIRE 7 31.4,119.1"))
        self.link.send(
            mavlink.MAVLink_command_int_message(
                254, 191, 0, mavlink.MAV_CMD_SPATIAL_USER_1, 0, 0, 7, 0.9, 1, 10, 314094222, 1191120167, 12
            )
        )


@pytest.fixture
def companion():
    return Companion()


def autopilot(companion, *args):
    process = start("mav_autopilot", "--port", companion.link.port, "--seconds", 60, *args)
    ready(process)
    return process


def end(process):
    process.terminate()
    return finish(process)


def test_autopilot_streams_and_answers(companion):
    process = autopilot(companion)
    companion.talk(3.0, {0.1: companion.sync, 1.0: companion.ask_attitude})
    summary = end(process)
    counts = companion.book.counts["1/1"]
    assert 100 <= counts["ATTITUDE_QUATERNION"] <= 200
    assert 100 <= counts["GLOBAL_POSITION_INT"] <= 200
    assert counts["ATTITUDE"] > 50, "SET_MESSAGE_INTERVAL took effect"
    assert all(ack["result"] == mavlink.MAV_RESULT_ACCEPTED for ack in companion.book.kept["command_acks"])
    assert summary["message_intervals"][0]["interval_us"] == 20_000
    assert summary["timesync"]["requests_received"] >= 20


def test_timesync_gives_the_boot_clock(companion):
    process = autopilot(companion, "--boot-age-s", 500)
    companion.talk(2.0, {0.05: companion.sync})
    end(process)
    now, boot, asked = min(companion.replies, key=lambda reply: reply[0] - reply[2])
    assert now - asked < 50_000_000
    assert 500e9 < boot < 504e9


def test_alarm_reaches_the_ground_and_comes_back_acknowledged(companion):
    ground = start("mav_ground", "--port", 0, "--ack-as", "254/191", "--ignore-first", 1, "--seconds", 60)
    process = autopilot(companion, "--ground-port", ready(ground)["port"])
    companion.talk(4.0, {0.5: companion.alarm})
    on_board, on_ground = end(process), end(ground)
    assert on_ground["statustexts"][0]["text"] == "FIRE 7 31.4,119.1"
    assert on_ground["command_ints"][0]["x"] == 314094222
    assert on_ground["ignored"] == 1 and set(on_ground["acknowledged"]) == {7}
    acks = companion.book.kept["command_acks"]
    assert acks and all(ack["result_param2"] == 7 and ack["from"] == "254/191" for ack in acks)
    assert on_board["forwarded"]["to_ground"] > 0 and on_board["forwarded"]["to_companion"] > 0
    assert {"255/190", "254/191"} <= companion.book.heartbeats.keys()


def test_ground_ends_when_it_has_what_it_waits_for(companion):
    ground = start("mav_ground", "--port", 0, "--until", "statustexts", "--seconds", 60)
    link = UdpLink(1, 191, send_to=f"127.0.0.1:{ready(ground)['port']}")
    link.send(mavlink.MAVLink_statustext_message(1, b"here"))
    assert finish(ground)["seconds"] < 10


def test_faults(companion):
    process = autopilot(companion, "--no-gps-fix", "--stale-attitude", 0.5, "--garbage", "--refuse-intervals")
    companion.talk(2.5, {0.5: companion.ask_attitude})
    end(process)
    counts = companion.book.counts["1/1"]
    assert 0 < counts["ATTITUDE_QUATERNION"] < 60
    assert companion.book.bad_data > 5
    assert companion.book.kept["command_acks"][0]["result"] == mavlink.MAV_RESULT_DENIED


@pytest.mark.parametrize(
    "angles, nose",
    [((0, 0, 0), (1, 0, 0)), ((0, 0, math.pi / 2), (0, 1, 0)), ((0, math.pi / 2, 0), (0, 0, -1))],
)
def test_quaternion_turns_the_nose_as_mavlink_says(angles, nose):
    """Body to NED: yaw 90 degrees points the nose east, pitch 90 degrees up."""
    w, x, y, z = quaternion(*angles)
    north = 1 - 2 * (y * y + z * z)
    east = 2 * (x * y + w * z)
    down = 2 * (x * z - w * y)
    assert (north, east, down) == pytest.approx(nose, abs=1e-12)


def test_tlog_summary(shared):
    summary = run("tlog_summary", shared / "mavlink" / "cuav_2018_flight_v2.tlog")
    assert summary["frames"] == 19_205
    assert summary["length_s"] == pytest.approx(185.0, abs=0.1)
    assert summary["messages"]["GPS_RAW_INT"]["rate_hz"] == pytest.approx(3.96, abs=0.01)
    assert summary["gnss_fix_types"].keys() == {"3"}


def test_tlog_without_a_fix_has_no_track(shared):
    summary = run("tlog_summary", shared / "mavlink" / "bench_nofix_v1.tlog")
    assert summary["track"]["GPS_RAW_INT"]["points"] == 0
    assert summary["track"]["GPS_RAW_INT"]["zero_positions"] > 100
