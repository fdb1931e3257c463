"""Where the right hand is, of `wepose live … --udp 9001`; ends after three seconds without a pose."""

import json
import select
import socket

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming:
    incoming.bind(("127.0.0.1", 9001))
    while select.select([incoming], [], [], 3.0)[0]:
        while select.select([incoming], [], [], 0.0)[0]:  # whoever is slow goes on with the newest pose
            line = incoming.recv(65535)
        pose = json.loads(line)
        print(f"{pose['t']:.3f} s  right hand {pose['points'].get('right_palm')} m", flush=True)
print("no pose for 3 s")
