"""SUMO's own drivers as VUT: a car-following model with SUMO's junction logic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.spec import ControllerKind
from merge_sumo.drivers.acceleration_lane import speed_to_stop_mps
from merge_sumo.drivers.base import MERGE, STAY, Driver, Scene
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, VUT
from merge_sumo.sumo.sumo_simulation import SumoSimulation

SHARED_OPTIONS = (
    "maxSpeed accel decel emergencyDecel apparentDecel tau minGap speedFactor impatience "
    "jmIgnoreFoeProb jmIgnoreFoeSpeed jmSigmaMinor jmStoplineGap jmTimegapMinor jmExtraGap "
    "jmAdvance"
)
LANE_CHANGE_OPTIONS = (
    "lcStrategic lcStrategicLookahead lcLookaheadLeft lcAssertive lcSigma lcCooperative "
    "lcCooperativeSpeed lcCooperativeMinSpeed lcCooperativeRoundabout lcCooperativeHelpTime "
    "lcCooperativeHelpThreshold lcSpeedGain lcSpeedGainRight lcSpeedGainLookahead "
    "lcSpeedGainRemainTime lcKeepRight lcKeepRightAcceptanceTime lcContRight lcOpposite "
    "lcOvertakeRight lcOvertakeDeltaSpeedFactor lcMaxSpeedLatStanding lcMaxSpeedLatFactor "
    "lcMaxDistLatStanding"
)
"""Options of SUMO's lane-change model LC2013; -1 turns some of them off. SUMO's other options are
those of its sublane model, which does not drive here."""
ACC = (
    "speedControlGain gapClosingControlGainSpeed gapClosingControlGainSpace gapControlGainSpeed "
    "gapControlGainSpace collisionAvoidanceGainSpeed collisionAvoidanceGainSpace "
    "collisionAvoidanceOverride"
)
MODELS = {
    "Krauss": "sigma sigmaStep",
    "IDM": "delta stepping",
    "EIDM": "delta stepping tpreview tPersDrive treaction tPersEstimate ccoolness jerkmax "
    "epsilonacc taccmax Mflatness Mbegin maxvehpreview sigmaleader sigmagap sigmaerror",
    "ACC": ACC,
    "CACC": f"{ACC} speedControlGainCACC gapClosingControlGainGap gapClosingControlGainGapDot "
    "gapControlGainGap gapControlGainGapDot collisionAvoidanceGainGap "
    "collisionAvoidanceGainGapDot",
}
"""Options of each model, in addition to the shared ones."""
NO_NOISE = {
    "Krauss": {"sigma": 0.0},
    "EIDM": {"sigmaleader": 0.0, "sigmagap": 0.0, "sigmaerror": 0.0},
}
"""Defaults that are not SUMO's: without noise all models are deterministic."""


class SumoKind(ControllerKind):
    """SUMO's own driver: `sumo:MODEL?NAME=VALUE&...`."""

    form = "sumo:MODEL[?OPTION=VALUE&...]"
    what = "a car-following model of SUMO: Krauss, IDM, EIDM, ACC or CACC, with its junction logic"
    example = '--vut "sumo:IDM?tau=1.2"'
    own_code = False

    def load(self) -> None:
        """Take model and options.

        Raises:
            UserError: for a model, an option or a value that SUMO does not have.
        """
        spec = self.spec
        model = spec.argument
        if model not in MODELS:
            raise UserError(f"{spec} is unknown: choose one of sumo:{', sumo:'.join(MODELS)}")
        known = f"{SHARED_OPTIONS} {LANE_CHANGE_OPTIONS} {MODELS[model]}".split()
        self.settable = chosen = spec.numbers()
        for name, value in chosen.items():
            if name not in known:
                raise spec.unknown_parameter(name, known)
            least = -1 if name.startswith("lc") else 0
            if value < least:
                raise UserError(f"{spec}: {name} is {value}: it must be {least} or more")
        self.vut_type = {"carFollowModel": model}
        for name, value in (NO_NOISE.get(model, {}) | chosen).items():
            self.vut_type[name] = f"{value:.12g}"

    def driver(self, corridors: int, simulation: object) -> Driver:
        """Return a driver in a simulation of SUMO.

        Args:
            corridors: number of corridors.
            simulation: a `SumoSimulation`.

        Raises:
            UserError: without one.
        """
        if not isinstance(simulation, SumoSimulation):
            raise UserError(f"{self.spec} drives only in a SUMO simulation")
        return SumoDriver(corridors, simulation)


class SumoDriver(Driver):
    """Answers the accelerations on which SUMO's models decide.

    In each step the models decide on a speed from the state, as in any SUMO simulation. For the VUT
    the POV is a vehicle on the road: before M with the right of way of the zipper junction, after M
    as a leader. The answer is the acceleration to that speed; it is clipped and counted like any
    other, and eq. (4) moves the vehicle. On an acceleration lane SUMO's lane-change model decides
    when to merge: the merge request is the lane of the VUT after SUMO's step.
    """

    def __init__(
        self, corridors: int, simulation: SumoSimulation, rows: Sequence[int] = (VUT,)
    ) -> None:
        """Drive vehicles of a simulation that was opened with a vType for them.

        Args:
            corridors: number of vehicles to drive.
            simulation: the simulation.
            rows: rows of the vehicles: that of the VUT, or those of cars of the mainline.
        """
        super().__init__(corridors)
        self.simulation, self._rows = simulation, list(rows)
        self._chooses = simulation.road.used_lane_m is not None and self._rows == [VUT]
        self._merges = np.zeros(simulation.corridors, dtype=np.bool_)

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations to the speeds that SUMO decided on, m/s2.

        Args:
            scene: the state of all corridors.
        """
        v_mps = self.simulation.v_mps[self._rows].ravel()
        wanted_mps = self.simulation.wanted_v_mps(self._rows)
        if self._chooses:
            self._merges = self.simulation.requests_merge()
            stays = ~self._merges if scene.merged is None else ~(self._merges | scene.merged)
            # In a step SUMO moves by the new speed and eq. (4) by the old one, so a driver that
            # brakes at the last moment would come a little beyond the end.
            next_m = scene.x_vut_m + v_mps * DT_S
            stops_mps = speed_to_stop_mps(next_m, self.simulation.scenario)
            wanted_mps = np.where(stays, np.minimum(wanted_mps, stops_mps), wanted_mps)
        acceleration: FloatArray = (wanted_mps - v_mps) / DT_S
        return acceleration

    def merge_requests(self) -> NDArray[np.int8] | None:
        """Return whether SUMO's lane-change model merged, (K,); None without a lane."""
        return np.where(self._merges, MERGE, STAY).astype(np.int8) if self._chooses else None
