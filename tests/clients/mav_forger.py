#!/usr/bin/env python3
"""Somebody who wants a companion computer to believe him: speaks as its autopilot, by pymavlink.

Each round sends an attitude without a signature, one that is signed with another secret, and one that was
recorded: by default the same well-signed frame again and again, with --recorded that one. A HEARTBEAT without a
signature goes with them. Prints what was sent, as JSON.
"""

import argparse
import time

from mavclient import UdpLink, mavlink, print_json, say_ready, secret

AUTOPILOT = (1, 1)
# A link id that nobody else has: the first frame of the new stream is good.
LINK_ID = 77


def links(args):
    plain, wrong, right = (UdpLink(*AUTOPILOT, send_to=f"127.0.0.1:{args.port}") for _ in range(3))
    wrong.sign(bytes(range(32)), 0)
    right.sign(args.sign, LINK_ID)
    return plain, wrong, right


def turned():
    """Lies on its back: whoever believed it would lose every position."""
    return mavlink.MAVLink_attitude_quaternion_message(
        int(time.monotonic() * 1e3) & 0xFFFFFFFF, 0, 1, 0, 0, 0, 0, 0
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--port", type=int, required=True, help="UDP port where the companion listens")
    add(
        "--sign",
        type=secret,
        required=True,
        metavar="FILE",
        help="the network's secret, for what is recorded",
    )
    add("--recorded", type=bytes.fromhex, metavar="HEX", help="a frame that passed once")
    add("--rounds", type=int, default=40)
    args = parser.parse_args()
    plain, wrong, right = links(args)
    recorded = args.recorded or turned().pack(right.mav)
    heartbeat = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )
    say_ready()
    for _ in range(args.rounds):
        plain.send(turned())
        wrong.send(turned())
        right.write(recorded)
        plain.send(heartbeat)
        time.sleep(0.02)
    print_json({"rounds": args.rounds})


if __name__ == "__main__":
    main()
