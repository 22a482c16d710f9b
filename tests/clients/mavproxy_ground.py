#!/usr/bin/env python3
"""MAVProxy as the ground station, without a window: a person who types commands and reads what it prints.

It is started as a program of its own, unmodified. Each --say is typed once a second until all that --expect
names was read; prints as JSON the line in which each was first seen, and what was not.
--after TEXT waits with the typing until that was read.

Exit code: 0 all seen, 1 not in time or MAVProxy ended.
"""

import argparse
import os
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from mavclient import print_json, say_ready

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Proxy:
    """The running program, and its lines."""

    def __init__(self, args, folder):
        program = Path(sys.executable).parent / "mavproxy.py"
        command = [
            sys.executable,
            "-u",
            str(program),
            "--state-basedir",
            folder,
            "--logfile",
            f"{folder}/mav.tlog",
        ]
        for master in args.master:
            command += ["--master", master]
        for module in args.module:
            command += ["--load-module", module]
        system, component = args.source.split("/")
        command += ["--source-system", system, "--source-component", component]
        command += ["--target-system", "1", "--target-component", str(args.target_component)]
        command += ["--default-modules", "log,misc,cmdlong,output,param", "--streamrate=-1", "--mav20"]
        self.lines = queue.Queue()
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=folder,
            env={**os.environ, "HOME": folder, "MAVLINK_DIALECT": "ardupilotmega"},
            text=True,
            errors="replace",
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.put(ESCAPES.sub("", line).rstrip())
        self.lines.put(None)

    def read(self):
        """The lines that are there; None among them when it has ended."""
        lines = []
        while True:
            try:
                lines.append(self.lines.get_nowait())
            except queue.Empty:
                return lines

    def say(self, text):
        try:
            self.process.stdin.write(text + "\n")
            self.process.stdin.flush()
        except OSError:
            pass

    def stop(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


def watch(proxy, args):
    seen, lines = {}, []
    end = time.monotonic() + args.seconds
    typed = 0.0
    ended = False
    while len(seen) < len(args.expect) and not ended and time.monotonic() < end:
        for line in proxy.read():
            ended = ended or line is None
            if line is None:
                continue
            lines.append(line)
            for wanted in args.expect:
                if wanted not in seen and re.search(wanted, line):
                    seen[wanted] = line
        may_type = args.after is None or any(args.after in line for line in lines)
        if may_type and time.monotonic() - typed > 1.0:
            typed = time.monotonic()
            for command in args.say:
                proxy.say(command)
        time.sleep(0.05)
    missing = [wanted for wanted in args.expect if wanted not in seen]
    return {"seen": seen, "missing": missing, "lines": lines[-80:]}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--master", action="append", required=True, help="as MAVProxy has it; may come again")
    add("--module", action="append", default=[], help="to load; may come again")
    add("--source", default="255/230", metavar="SYSTEM/COMPONENT", help="as whom it speaks")
    add("--target-component", type=int, default=1)
    add("--say", action="append", default=[], metavar="COMMAND", help="typed once a second; may come again")
    add("--after", metavar="TEXT", help="nothing is typed before this was read")
    add("--expect", action="append", default=[], metavar="REGEX", help="to read; may come again")
    add("--seconds", type=float, default=30.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="emberfix-mavproxy-", ignore_cleanup_errors=True) as folder:
        proxy = Proxy(args, folder)
        say_ready()
        try:
            found = watch(proxy, args)
        finally:
            proxy.stop()
    print_json(found)
    sys.exit(0 if not found["missing"] else 1)


if __name__ == "__main__":
    main()
