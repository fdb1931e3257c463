"""Where the right hand is, of `wepose live … --output udp:9001`; waits for ever, ends by Ctrl-C."""

import contextlib
import json
import select
import socket

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming, contextlib.suppress(KeyboardInterrupt):
    incoming.bind(("127.0.0.1", 9001))
    print("waiting for poses on 127.0.0.1:9001; Ctrl-C ends", flush=True)
    while line := incoming.recv(65535):
        while select.select([incoming], [], [], 0.0)[0]:  # a slow receiver continues with the newest pose
            line = incoming.recv(65535)
        pose = json.loads(line)
        print(f"{pose['t']:.3f} s  right hand {pose['points'].get('right_palm')} m", flush=True)
        if not select.select([incoming], [], [], 3.0)[0]:
            print("no pose for 3 s; waiting", flush=True)
