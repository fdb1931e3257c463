"""How a recording is tracked."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import BadOption
from ..filters import BEST, OFFLINE, check_method
from ..filters.static import StaticTest


@dataclass(frozen=True)
class TrackOptions:
    """What is chosen for `Tracker`, beside the person and the body model.

    Parameters
    ----------
    method : the orientation filter, a key of `wepose_pin.filters.METHODS`
    static_test : when a sensor counts as static; None: the default values
    open_loop : do not correct heading drift, neither by joint accelerations, hinges and joined hands, nor by the resets
        of a live session: orientations are the filter's from the start pose on
    causal : begin at the end of the start pose and look at nothing ahead, as a live session does
    limits : keep the limits of the model's joints of one axis

    Raises
    ------
    BadOption
        A method that is not known, or that needs the whole recording where `causal` is chosen.
    """

    method: str = BEST
    static_test: StaticTest | None = None
    open_loop: bool = False
    causal: bool = False
    limits: bool = True

    def __post_init__(self) -> None:
        check_method(self.method)
        if self.causal and self.method in OFFLINE:
            raise BadOption(f"method '{self.method}' needs the whole recording; 'amekf' looks at nothing ahead")
