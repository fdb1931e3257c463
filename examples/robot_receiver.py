"""Commands of `wepose live … --robot NAME`, as a robot's driver reads them; ends where they cease."""

import json
import socket

with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as incoming:
    incoming.bind(("127.0.0.1", 9002))
    incoming.settimeout(3.0)  # for the first; from then on a tenth of a second without one is too long
    try:
        while True:
            command = json.loads(incoming.recv(65535))
            incoming.settimeout(0.1)
            print(command["n"], command["state"], command["position"], flush=True)
    except TimeoutError:
        print("no command: the robot is to be stopped here")
