"""Five sensors over UDP to `wepose live --source udp:9000`: counts of an MPU-6050 to SI units, in `read_counts`."""

import argparse
import json
import math
import socket
import time

parser = argparse.ArgumentParser()
parser.add_argument("--host", default="127.0.0.1", help="where `wepose live` runs")
parser.add_argument("--port", type=int, default=9000)
parser.add_argument("--seconds", type=float, default=2.0, help="inf sends until Ctrl-C")
options = parser.parse_args()

SENSORS = ("torso", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm")
RATE_HZ = 100.0
# Counts of an MPU-6050 at ±2000 deg/s and ±8 g, from its data sheet, to rad/s and m/s².
RAD_S_PER_COUNT = math.radians(1.0 / 16.4)
M_S2_PER_COUNT = 9.80665 / 4096.0


def read_counts(sensor: str, t: float) -> tuple[list[int], list[int]]:
    """Stand in for your driver: counts of gyro and accel, x up and z backwards while the arm hangs.

    Five seconds of rest, then each forearm flexes by up to 60 deg about its y axis, once in two seconds.
    """
    angle, rate = 0.0, 0.0
    if sensor.endswith("forearm") and t > 5.0:
        angle = math.radians(30.0) * (1.0 - math.cos(math.pi * t))
        rate = math.radians(30.0) * math.pi * math.sin(math.pi * t)
    gyro = [0.0, rate / RAD_S_PER_COUNT, 0.0]
    up = 9.80665 / M_S2_PER_COUNT
    return [round(v) for v in gyro], [round(v) for v in (up * math.cos(angle), 0.0, up * math.sin(angle))]


sent, start = 0, time.monotonic()
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outgoing:
    while (t := sent / RATE_HZ) < options.seconds:
        lines = []
        for sensor in SENSORS:
            gyro, accel = read_counts(sensor, t)
            sample = {
                "sensor": sensor,
                "t": t,  # [s] of this program's clock, the same for all sensors; take the sensor's own where it has one
                "gyro": [RAD_S_PER_COUNT * count for count in gyro],  # [rad/s]
                "accel": [M_S2_PER_COUNT * count for count in accel],  # [m/s²], +g up at rest
            }
            lines.append(json.dumps(sample))
        outgoing.sendto("\n".join(lines).encode(), (options.host, options.port))
        sent += 1
        time.sleep(max(0.0, start + sent / RATE_HZ - time.monotonic()))
print(f"sent {sent} samples of each of {len(SENSORS)} sensors to {options.host}:{options.port}")
