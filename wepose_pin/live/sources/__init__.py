"""Sources of live samples: one file a kind, one protocol (`base.Source`)."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path

from ...errors import BadOption, one_of
from ...model import load_table
from ..addresses import parse_address, parse_listening_address
from .base import Source
from .packets import AnyName

FORMS = {
    "replay": "replay:PATH",
    "lsl": "lsl:NAME[@machine|link|site]",
    "udp": "udp:[HOST:]PORT[,gyro_unit=deg/s][,accel_unit=g]",
    "mti": "mti:DEVICE=SEGMENT,DEVICE=SEGMENT[@RATE]",
    "slimevr": "slimevr:[HOST][:PORT][,TRACKER=SEGMENT...]",
}
REMOVED = {  # kind → what to do instead
    "mvn": "export the trial of MVN as .mvnx, which `wepose track` reads",
    "ximu3": "send its samples to udp:PORT, or read the CSV of the x-IMU3 GUI",
}


def open_source(
    spec: str,
    *,
    sensors: Sequence[str] | None = None,
    speed: float | str = 1.0,
    baud: int = 115200,
    wait_s: float = 10.0,
    segments: Sequence[str] | None = None,
    any_name: bool = False,
) -> Source:
    """The source that `spec` describes, not yet opened.

    Parameters
    ----------
    spec : one of `FORMS`, as ``replay:PATH`` (a session.toml or its folder) or ``udp:PORT``; docs/live-sources.md says
        what each takes
    sensors : to take; None: all that the source has. A UDP or LSL source waits for its sensors in `open`
    speed : of a replay: 1.0 its own, 4.0 four times that, "max" as fast as possible
    baud : of serial ports
    wait_s : how long `open` waits for streams or senders [s]
    segments : names that sensors of a stream may have, those of the body; None: the upper body's. A replay has its own
    any_name : take sensors of any name from UDP and SlimeVR, whenever they begin to send; they are assigned to segments
        later

    Raises
    ------
    BadOption
        No such kind of source, or it names what does not exist; WeposeErrors of the recording that is replayed.
    """
    kind, colon, rest = spec.partition(":")
    if kind in REMOVED:
        raise BadOption(f"source '{spec}' is none any more: {REMOVED[kind]}")
    if kind not in FORMS or not colon or not (rest or kind == "slimevr"):
        raise BadOption(f"source '{spec}' is none; {one_of(FORMS.values(), kind)}")
    if kind == "replay":
        return _open_replay(spec, rest, sensors, speed)
    segments = tuple(load_table().segments) if segments is None else segments
    unknown = [name for name in sensors or () if name not in segments]
    if unknown:
        raise BadOption(f"source '{spec}': '{unknown[0]}' is not a segment; {one_of(segments, unknown[0])}")
    if kind == "lsl":
        return _open_lsl(spec, rest, sensors, wait_s, segments)
    if kind == "udp":
        return _open_udp(spec, rest, sensors, wait_s, AnyName() if any_name else segments)
    if kind == "slimevr":
        return _open_slimevr(spec, rest, sensors, wait_s, segments, any_name)
    return _open_mti(spec, rest, sensors, baud, segments)


def _open_replay(spec: str, path: str, sensors: Sequence[str] | None, speed: float | str) -> Source:
    from dataclasses import replace

    from ...readers import load_session
    from .replay import ReplaySource

    try:
        factor = math.inf if speed == "max" else float(speed)
    except ValueError:
        factor = math.nan
    if not factor > 0.0:
        raise BadOption(f"speed: '{speed}'; a positive number, 1.0 is the recording's own, or max")
    recording = load_session(Path(path), gaps=True)
    if sensors is not None:
        missing = [name for name in sensors if name not in recording.sensors]
        if missing:
            raise BadOption(f"source '{spec}': no sensor {missing[0]}; {one_of(recording.sensors, missing[0])}")
        recording = replace(recording, sensors={name: recording.sensors[name] for name in sensors})
    return ReplaySource(recording, factor)


def _open_lsl(spec: str, rest: str, sensors: Sequence[str] | None, wait_s: float, segments: Sequence[str]) -> Source:
    from .lsl import SCOPES, LslSource

    name, separator, scope = rest.rpartition("@")
    if not separator:
        return LslSource(rest, sensors, None, wait_s, segments)
    if scope not in SCOPES:
        raise BadOption(f"source '{spec}': '{scope}' is no reach of a search; {one_of(SCOPES, scope)}")
    return LslSource(name, sensors, scope, wait_s, segments)


def _open_udp(spec: str, rest: str, sensors: Sequence[str] | None, wait_s: float, segments: Collection[str]) -> Source:
    from .packets import UNITS
    from .udp import UdpSource

    address, *options = rest.split(",")
    host, port = parse_address(address, f"source '{spec}':", 9000)
    units: dict[str, str] = {}
    for option in options:
        key, _, unit = option.partition("=")
        if key not in UNITS:
            raise BadOption(f"source '{spec}': '{option}' is no unit; {one_of(UNITS, key)}, as gyro_unit=deg/s")
        if unit not in UNITS[key]:
            raise BadOption(f"source '{spec}': {key} '{unit}' is not known; {one_of(UNITS[key], unit)}")
        units[key] = unit
    return UdpSource(host, port, sensors, segments, wait_s, units=units)


def _open_mti(spec: str, rest: str, sensors: Sequence[str] | None, baud: int, segments: Sequence[str]) -> Source:
    from .mti import MTiSource

    pairs, separator, rate = rest.rpartition("@")
    rate_hz = None
    if separator:
        if not (rate.isascii() and rate.isdigit() and 0 < int(rate) <= 2000):
            raise BadOption(f"source '{spec}': rate '{rate}'; whole samples a second from 1 to 2000, as @100")
        rate_hz = int(rate)
    devices = _choose_devices(spec, _read_pairs(spec, pairs if separator else rest, segments, "/dev/ttyUSB0"), sensors)
    return MTiSource(devices, rate_hz, baud)


def _open_slimevr(
    spec: str,
    rest: str,
    sensors: Sequence[str] | None,
    wait_s: float,
    segments: Sequence[str],
    any_name: bool,
) -> Source:
    from .slimevr import PORT, SlimeVrSource

    address, _, pairs = rest.partition(",")
    host, port = parse_listening_address(address, f"source '{spec}':", PORT)
    assigned = {}
    if pairs:
        assigned = {
            tracker.lower(): segment
            for segment, tracker in _read_pairs(spec, pairs, segments, "4c:11:ae:00:00:01/0").items()
        }
    names = AnyName() if any_name else segments
    return SlimeVrSource(host, port, sensors or list(assigned.values()), names, wait_s, assigned=assigned)


def _read_pairs(spec: str, text: str, segments: Sequence[str], example: str) -> dict[str, str]:
    """Segment → device of ``DEVICE=SEGMENT,…``."""
    devices: dict[str, str] = {}
    for pair in text.split(","):
        device, equals, segment = pair.rpartition("=")
        if not equals or not device:
            raise BadOption(f"source '{spec}': '{pair}' is no DEVICE=SEGMENT, as {example}={segments[0]}")
        if segment not in segments:
            raise BadOption(f"source '{spec}': '{segment}' is not a segment; {one_of(segments, segment)}")
        if segment in devices or device in devices.values():
            raise BadOption(f"source '{spec}': '{pair}': each device and each segment is named once")
        devices[segment] = device
    return devices


def _choose_devices(spec: str, devices: dict[str, str], sensors: Sequence[str] | None) -> dict[str, str]:
    """The devices of the chosen sensors, in their order; None: all."""
    if sensors is None:
        return devices
    missing = [name for name in sensors if name not in devices]
    if missing:
        raise BadOption(f"source '{spec}': no device for {missing[0]}; {one_of(devices, missing[0])}")
    return {name: devices[name] for name in sensors}
