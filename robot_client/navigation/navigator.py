"""Brings a robot to one goal after another: plans, follows, recovers, gives up. Pure; time is an argument.

Its states are a table. Nothing moves while a sensor or the pose is missing or late, nor right after a pause of the
program: a process that was frozen may have missed a stop.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from robot_client.navigation.costmap import Costmap, OccupancyMap, SensorView
from robot_client.navigation.grid import Floats, Pose2D, angle_between
from robot_client.navigation.outcome import ErrorCode, GoalEnd, NavigationError, NavigationOutcome
from robot_client.navigation.planner import PathSearch
from robot_client.navigation.pursuit import STANDSTILL, DriveCommand, DriveLimits, PathFollower
from robot_client.navigation.recovery import MOST_RECOVERIES, Recovery, recovery

LATE_POSE, LATE_SENSOR, LATE_LOCALISER = 0.3, 0.6, 3.0
"""Seconds after which a pose by odometry, a sensor and, unless set, a localiser's transform are too old to move by."""

TICK = 0.05
"""Seconds between two commands."""

LONGEST_PAUSE = 0.25
"""Seconds between two ticks after which the robot stands for one tick, so that requests that waited come first."""

INPUT_PATIENCE = 10.0
"""Seconds a goal waits for pose and sensors."""

REPLAN_EVERY = 2.0
"""Seconds between two plans, though the old path is free."""

PROGRESS_SECONDS, PROGRESS_DISTANCE, PROGRESS_ANGLE = 6.0, 0.15, 0.5
"""A robot that moves less than this many metres and radians within this time is stuck."""

BLOCKED_SECONDS = 2.0
"""Seconds the robot stands before an obstacle on its path until it counts as stuck."""


class NavigatorState(enum.Enum):
    """What the navigator does."""

    IDLE = "idle"
    PLANNING = "planning"
    FOLLOWING = "following"
    RECOVERING = "recovering"


class NavigatorEvent(enum.Enum):
    """What changes the state."""

    GOAL = "goal"
    PATH = "path"
    STUCK = "stuck"
    RECOVERED = "recovered"
    END = "end"


TRANSITIONS: dict[tuple[NavigatorState, NavigatorEvent], NavigatorState] = {
    (NavigatorState.IDLE, NavigatorEvent.GOAL): NavigatorState.PLANNING,
    (NavigatorState.PLANNING, NavigatorEvent.PATH): NavigatorState.FOLLOWING,
    (NavigatorState.PLANNING, NavigatorEvent.STUCK): NavigatorState.RECOVERING,
    (NavigatorState.FOLLOWING, NavigatorEvent.STUCK): NavigatorState.RECOVERING,
    (NavigatorState.RECOVERING, NavigatorEvent.RECOVERED): NavigatorState.PLANNING,
    (NavigatorState.PLANNING, NavigatorEvent.END): NavigatorState.IDLE,
    (NavigatorState.FOLLOWING, NavigatorEvent.END): NavigatorState.IDLE,
    (NavigatorState.RECOVERING, NavigatorEvent.END): NavigatorState.IDLE,
}


class NavigatorSettings(NamedTuple):
    """Settings.

    :ivar sensors: names of the sensors that must be fresh
    :ivar radius: of the robot's hull, metres
    :ivar inflation: metres from obstacles within which positions cost
    :ivar localiser_timeout: seconds that the localiser may be silent
    """

    sensors: tuple[str, ...]
    radius: float = 0.2
    inflation: float = 0.5
    limits: DriveLimits = DriveLimits()
    localiser_timeout: float = LATE_LOCALISER


class NavigationProgress(NamedTuple):
    """Progress of a goal.

    :ivar seconds: since it was accepted
    :ivar seconds_left: estimated
    :ivar distance_left: metres along the path
    """

    seconds: float
    seconds_left: float
    distance_left: float
    recoveries: int


class _Refusal(NamedTuple):
    """Inputs of a sensor that were refused, one after the other.

    :ivar since: when the first came
    :ivar at: when the last came
    """

    since: float
    at: float
    why: str


@dataclass
class _GoalUnderWay:
    pose: Pose2D
    frame: str
    """The map's frame, in which the pose is."""
    since: float
    recoveries: int = 0
    search: PathSearch | None = None
    follower: PathFollower | None = None
    recovery: Recovery | None = None
    planned_at: float = 0.0
    blocked_since: float | None = None
    inputs_since: float = 0.0
    """When pose and sensors were last fresh."""
    mark: Pose2D | None = None
    """The pose at which progress was last made."""
    mark_at: float = 0.0
    error: NavigationError = field(
        default_factory=lambda: NavigationError(ErrorCode.FAILED_TO_MAKE_PROGRESS, "the robot is stuck")
    )


class Navigator:
    """Navigates one robot. The owner calls :meth:`tick` about twenty times a second while a goal is active.

    :param settings: of the robot
    """

    def __init__(self, settings: NavigatorSettings) -> None:
        self.settings = settings
        self.state = NavigatorState.IDLE
        self.map_frame = ""
        """The map's coordinate frame; empty before there is a map."""
        self.costmap: Costmap | None = None
        self.pose: Pose2D | None = None
        self.on_path: Callable[[Floats], None] = lambda path: None
        """Called with each new path, points in the map, shape (n, 2)."""
        self._goal: _GoalUnderWay | None = None
        self._pose_at = self._localiser_at = float("-inf")
        self._pose_problem = ""
        self._seen_at: dict[str, float] = {}
        self._refusals: dict[str, _Refusal] = {}
        """By sensor, since its last good input."""
        self._last = STANDSTILL
        self._ticked_at: float | None = None

    @property
    def goal(self) -> Pose2D | None:
        """The goal under way."""
        return self._goal.pose if self._goal else None

    # --- inputs --------------------------------------------------------------------------------------------

    def set_map(self, found: OccupancyMap) -> None:
        """Use a map; SLAM and map servers send it again and again.

        What the sensors saw stays, also where the grid has another place or size. A map in another frame forgets it,
        and ends the goal.
        """
        old = self.costmap
        if old is not None and found.frame == self.map_frame and found.geometry == old.geometry:
            changed = old.set_occupancy(found.occupancy)
        else:
            changed = True
            self._replace_costmap(found, old if found.frame == self.map_frame else None)
        if changed and self._goal is not None and self.state is NavigatorState.FOLLOWING:
            self._goal.planned_at = float("-inf")

    def _replace_costmap(self, found: OccupancyMap, known: Costmap | None) -> None:
        """:param known: a costmap in the same frame, whose obstacles are taken over"""
        settings = self.settings
        self.costmap = Costmap(
            found.geometry, found.occupancy, settings.sensors, settings.radius, settings.inflation
        )
        if known is not None:
            self.costmap.take_obstacles(known)
        if found.frame != self.map_frame:
            self.map_frame, self.pose = found.frame, None
        if self._goal is not None:
            self._goal.search = None  # it searches the old grid

    def set_pose(self, pose: Pose2D, at: float, localiser_at: float = math.inf) -> None:
        """The robot's pose in the map.

        :param at: when the odometry came
        :param localiser_at: when the odometry's place in the map came; infinite: it is fixed
        """
        self.pose, self._pose_at, self._localiser_at = pose, at, localiser_at

    def refuse_pose(self, why: str) -> None:
        """The robot's pose was not found."""
        self._pose_problem = why

    def observe(self, sensor: str, view: SensorView, now: float) -> None:
        """What a sensor of :attr:`NavigatorSettings.sensors` sees."""
        self._seen_at[sensor] = now
        self._refusals.pop(sensor, None)
        if self.costmap is not None:
            self.costmap.observe(sensor, view)
            self.costmap.update(view.origin)

    def refuse(self, sensor: str, why: str, now: float) -> None:
        """An input of a sensor can't be used."""
        before = self._refusals.get(sensor)
        self._refusals[sensor] = _Refusal(before.since if before else now, now, why)

    def refused(self) -> str:
        """Why a sensor's inputs have been refused for longer than it may be late; empty if none's are."""
        for sensor, refusal in self._refusals.items():
            if refusal.at - refusal.since > LATE_SENSOR:
                return _refused(sensor, refusal)
        return ""

    # --- goals ---------------------------------------------------------------------------------------------

    def start(self, goal: Pose2D, now: float) -> None:
        """Go to a goal; one under way must be ended before."""
        self._event(NavigatorEvent.GOAL)
        self._goal = _GoalUnderWay(goal, self.map_frame, now, inputs_since=now)
        self._last, self._ticked_at = STANDSTILL, None

    def cancel(self) -> None:
        """End the goal; the owner publishes zero at once."""
        if self._goal is not None:
            self._end()

    def progress(self, now: float) -> NavigationProgress | None:
        """Progress of the goal; ``None`` without one."""
        goal = self._goal
        if goal is None:
            return None
        if goal.follower is not None:
            distance = goal.follower.distance_left
        else:
            distance = self.pose.distance(goal.pose.x, goal.pose.y) if self.pose else 0.0
        usual = 0.7 * self.settings.limits.speed
        return NavigationProgress(now - goal.since, distance / usual, distance, goal.recoveries)

    def tick(self, now: float) -> tuple[DriveCommand, NavigationOutcome | None]:
        """What to drive now, and the end of the goal if it has come; standstill without a goal."""
        goal, before, self._ticked_at = self._goal, self._ticked_at, now
        if goal is None:
            return STANDSTILL, None
        seconds = TICK if before is None else now - before
        if seconds > LONGEST_PAUSE:
            return self._stand(), None
        try:
            wanted = self._step(goal, now, max(seconds, 1e-3))
        except NavigationError as error:
            self._end()
            return STANDSTILL, NavigationOutcome(GoalEnd.ABORTED, error.error_code, str(error))
        if wanted is None:
            self._end()
            return STANDSTILL, NavigationOutcome(GoalEnd.SUCCEEDED)
        self._last = wanted
        return wanted, None

    # --- steps of a goal -----------------------------------------------------------------------------------

    def _step(self, goal: _GoalUnderWay, now: float, seconds: float) -> DriveCommand | None:
        """What to drive; ``None``: the goal is reached.

        :raises NavigationError: it is given up
        """
        if goal.frame and goal.frame != self.map_frame:
            changed = (
                f"the map's frame is now '{self.map_frame}', no longer '{goal.frame}'; send the goal again"
            )
            raise NavigationError(ErrorCode.FOLLOW_TF_ERROR, changed)
        missing = self.missing(now)
        if missing is not None:
            if now - goal.inputs_since > INPUT_PATIENCE:
                raise missing
            goal.mark = None
            return self._stand()
        goal.inputs_since = now
        assert self.costmap is not None and self.pose is not None
        if self.state is NavigatorState.RECOVERING:
            return self._recover(goal, self.pose, self.costmap, now)
        if self.state is NavigatorState.PLANNING:
            self._plan(goal, self.pose, self.costmap, now)
            return self._stand()
        return self._follow(goal, self.pose, self.costmap, now, seconds)

    def missing(self, now: float) -> NavigationError | None:
        """Why the robot may not move now; ``None`` if it may."""
        if self.costmap is None:
            return NavigationError(ErrorCode.PLAN_UNKNOWN, "there is no map")
        if self.pose is None:
            unknown = "the robot's pose in the map is not known"
            words = f"{unknown}: {self._pose_problem}" if self._pose_problem else unknown
            return NavigationError(ErrorCode.FOLLOW_TF_ERROR, words)
        if now - self._pose_at > LATE_POSE:
            silent = f"the odometry's transform has not come for {now - self._pose_at:.1f} s"
            return NavigationError(ErrorCode.FOLLOW_TF_ERROR, silent)
        if now - self._localiser_at > self.settings.localiser_timeout:
            silent = f"the localiser's transform has not come for {now - self._localiser_at:.1f} s"
            return NavigationError(ErrorCode.FOLLOW_TF_ERROR, silent)
        for sensor in self.settings.sensors:
            if now - self._seen_at.get(sensor, float("-inf")) > LATE_SENSOR:
                refusal = self._refusals.get(sensor)
                words = _refused(sensor, refusal) if refusal else f"the sensor '{sensor}' is silent"
                return NavigationError(ErrorCode.FOLLOW_UNKNOWN, words)
        return None

    def _plan(self, goal: _GoalUnderWay, pose: Pose2D, costmap: Costmap, now: float) -> None:
        """Go on with the search while the robot stands."""
        try:
            path = self._search(goal, pose, costmap)
        except NavigationError as error:
            if error.error_code is not ErrorCode.NO_VALID_PATH:  # a recovery would not help
                raise
            self._stuck(goal, pose, now, error)
            return
        if path is not None:
            self._use_path(goal, path, now)
            goal.mark, goal.mark_at = pose, now
            self._event(NavigatorEvent.PATH)

    def _search(self, goal: _GoalUnderWay, pose: Pose2D, costmap: Costmap) -> Floats | None:
        try:
            goal.search = goal.search or PathSearch(costmap, pose, goal.pose)
            path = goal.search.advance()
        except NavigationError:
            goal.search = None
            raise
        if path is not None:
            goal.search = None
        return path

    def _use_path(self, goal: _GoalUnderWay, path: Floats, now: float) -> None:
        goal.follower = PathFollower(path, goal.pose, self.settings.limits)
        goal.planned_at = now
        self.on_path(path)

    def _follow(
        self, goal: _GoalUnderWay, pose: Pose2D, costmap: Costmap, now: float, seconds: float
    ) -> DriveCommand | None:
        assert goal.follower is not None
        self._replan(goal, pose, costmap, now)
        wanted = goal.follower.command(pose, self._last, costmap, seconds)
        if wanted is None:
            return None
        if wanted == STANDSTILL:
            goal.blocked_since = goal.blocked_since or now
            if now - goal.blocked_since > BLOCKED_SECONDS:
                blocked = NavigationError(ErrorCode.NO_VALID_CONTROL, "an obstacle is in the way")
                self._stuck(goal, pose, now, blocked)
            return self._stand()
        goal.blocked_since = None
        if not self._progresses(goal, pose, now):
            failed = NavigationError(ErrorCode.FAILED_TO_MAKE_PROGRESS, "the robot does not get on")
            self._stuck(goal, pose, now, failed)
            return self._stand()
        return wanted

    def _replan(self, goal: _GoalUnderWay, pose: Pose2D, costmap: Costmap, now: float) -> None:
        """Plan again now and then, and where an obstacle is on the path; the old path is followed meanwhile."""
        assert goal.follower is not None
        due = now - goal.planned_at > REPLAN_EVERY or goal.follower.is_blocked(costmap)
        if goal.search is None and not due:
            return
        try:
            path = self._search(goal, pose, costmap)
        except NavigationError:
            goal.planned_at = now  # what is before the robot on the old path stops it
            return
        if path is not None:
            self._use_path(goal, path, now)

    def _progresses(self, goal: _GoalUnderWay, pose: Pose2D, now: float) -> bool:
        mark = goal.mark
        moved = mark is None or (
            pose.distance(mark.x, mark.y) > PROGRESS_DISTANCE
            or abs(angle_between(pose.heading, mark.heading)) > PROGRESS_ANGLE
        )
        if moved:
            goal.mark, goal.mark_at = pose, now
        return now - goal.mark_at <= PROGRESS_SECONDS

    def _stuck(self, goal: _GoalUnderWay, pose: Pose2D, now: float, error: NavigationError) -> None:
        """Begin a recovery.

        :raises NavigationError: there were enough
        """
        if goal.recoveries >= MOST_RECOVERIES:
            raise error
        goal.recoveries += 1
        goal.recovery, goal.search, goal.blocked_since = recovery(goal.recoveries, pose, now), None, None
        self._event(NavigatorEvent.STUCK)

    def _recover(self, goal: _GoalUnderWay, pose: Pose2D, costmap: Costmap, now: float) -> DriveCommand:
        assert goal.recovery is not None
        wanted = goal.recovery.command(pose, costmap, now)
        if wanted is None:
            goal.recovery = None
            self._event(NavigatorEvent.RECOVERED)
            return self._stand()
        return wanted

    def _stand(self) -> DriveCommand:
        self._last = STANDSTILL
        return STANDSTILL

    def _end(self) -> None:
        self._event(NavigatorEvent.END)
        self._goal, self._last = None, STANDSTILL

    def _event(self, event: NavigatorEvent) -> None:
        self.state = TRANSITIONS[self.state, event]


def _refused(sensor: str, refusal: _Refusal) -> str:
    return f"data of the sensor '{sensor}' are refused: {refusal.why}"
