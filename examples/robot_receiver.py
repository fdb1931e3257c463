"""Commands of `wepose live … --robot NAME`, as a robot's driver reads them; waits for ever, ends by Ctrl-C."""

import argparse
import contextlib
import json
import socket

parser = argparse.ArgumentParser()
parser.add_argument("--port", type=int, default=9002)
parser.add_argument("--timeout", type=float, metavar="SECONDS", help="end after so long without a command")
options = parser.parse_args()
SILENCE = 0.1  # s without a command, after which the robot is to be stopped

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming, contextlib.suppress(KeyboardInterrupt):
    incoming.bind(("127.0.0.1", options.port))
    print(f"waiting for commands on 127.0.0.1:{options.port}; Ctrl-C ends", flush=True)
    incoming.settimeout(options.timeout)
    with contextlib.suppress(TimeoutError):
        while True:
            command = json.loads(incoming.recv(65535))
            print(command["n"], command["state"], command["position"], flush=True)
            incoming.settimeout(SILENCE)
            try:
                incoming.recv(1, socket.MSG_PEEK)
            except TimeoutError:
                print("no command: the robot is to be stopped here; waiting", flush=True)
                incoming.settimeout(options.timeout)
