"""Tracking: the pose of a touched object in every frame, from its pose in the last one."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.linalg import inv
from torch import Tensor

from ..core.checks import check_positive
from ..core.geometry import check_rigid
from ..skin import DotMotion
from .ambiguity import UNKNOWN_VARIANCE
from .direct import equal_poses, likely_poses, symmetries
from .dots import carried, fused, points_under
from .follow import TRUSTED_DEG, TRUSTED_MM, Followed, follow, in_common
from .grids import LEAST_CELLS, DepthFrame, Grids, Surface, Unusable, grids, pitch_by_slopes, surface_of
from .inverse import LEAST_SLOPE_NOISE
from .keyframe import KeyframeGraph, make_keyframe
from .result import Registration
from .rigid import Array, cross, distance_mm, moved_covariance, orthonormal

HALF = 0.5
"""A keyframe that shows half as much as it could makes room for another one: half of the smaller contact is in common, the variance
is twice the least since it was taken up, or the contact is twice its own. Half of the reference's contact is no keyframe."""

JUMP_MM = 1.0
"""Motion of the contact between frames, beside the expected one, beyond which a pose is not taken: another one may look alike."""

PITCH_RATIO = 1.5
"""Ratio of the pitch that depth and slopes have and the one given, beyond which a frame has another one. It is 0.86 to 0.99 on
frames of the tracking bench, lifted off or half out of the image too."""


@dataclass(frozen=True, eq=False)
class TrackedPose(Registration):
    """Pose of the reference in a frame: a :class:`Registration` whose source is the reference and whose target is the frame.

    ``converged`` is True where three standard deviations of what is known, the drift of the way over keyframes among them, are
    within 1 degree and 0.15 mm. They include errors of slopes that are alike over wide areas, as far as parts of the contact
    disagree about them; where a sensor's slopes err by degrees, the object is followed, few poses are converged, and ``covariance``
    says how uncertain the others are.

    Attributes:
        lost: why there is no pose, in words; empty if there is one. Then the last pose is given, with ``converged`` False.
        keyframe: index of the keyframe that the frame was compared with; 0 is the reference.
        drift_deg: standard deviation of the rotation that the way over keyframes adds, degrees; 0 for the reference.
        drift_mm: the same of the position of the contact, mm.
    """

    lost: str = ""
    keyframe: int = 0
    drift_deg: float = 0.0
    drift_mm: float = 0.0


class PoseTracker:
    """The pose of a touched object in every frame, beginning with a reference: ``tracker(frame)``.

    Each frame is aligned with a keyframe from the last pose: Gauss-Newton on slopes and heights of the pixels that touch in
    both, with derivatives computed once per keyframe. Motions that the contact does not determine keep their value and are named
    in ``ambiguous``. Where the contact has little in common with the reference any more, or what they have in common shows the pose
    less well, frames become keyframes in turn; where an older keyframe is seen again, the loop is closed and tracking goes on with
    that. A pose that contradicts the frame is not returned: ``lost`` says why, and the next frames are searched as
    :func:`register_depth` does, until the object is found.
    Of a symmetric object it may then be found in another of its equal poses: from there on ``alternatives`` lists the others.
    Where the printed dots of the skin are given, too, they are one more measurement: each pose is fused with the one that the dots
    under the object have carried on from the reference, as long as they do not contradict the contact. ``covariance`` then holds if
    the skin sticks: slip along a motion that the contact does not show is not seen, and ``converged`` does not count on dots.

    Args:
        reference: the first frame, a :class:`torchvts.DepthOutput` or any object with its depth_mm, gradient and contact.
        mm_per_pixel: pitch of all frames, mm.
        moved: motion of the dots in the reference, of :class:`torchvts.SkinMotion`; None for none.
    Attributes:
        graph: the keyframes and their poses.
        closures: how far each closed loop contradicted the poses before, (degrees, mm).
    Raises:
        TypeError: no DepthOutput.
        ValueError: no contact, or one too small or too faint; a pitch that depth and slopes of the reference contradict.
    Source:
        inverse compositional: Baker, Matthews, IJCV 56(3), 2004; normals of tactile images by Gauss-Newton: Huang, Kaess, Yuan,
        NormalFlow, arXiv 2412.09617; keyframes by what a frame shows of the pose: Kerl, Sturm, Cremers, IROS 2013.
    Example:
        >>> from torchvts.scenes import objects
        >>> press = lambda deg, x: objects.press(objects.stamp("T"), objects.pose(deg, (x, 0.0)), 96, 128, 0.125)
        >>> tracker = PoseTracker(press(0.0, 0.0), 0.125)
        >>> found = [tracker(press(2.0 * k, 0.1 * k)) for k in range(4)]
        >>> round(math.degrees(math.acos(float(found[3].T_target_source[0, 0]))), 1), found[3].lost
        (6.0, '')
        >>> tracker(press(40.0, 5.0)).converged
        False
    """

    def __init__(self, reference: DepthFrame, mm_per_pixel: float, moved: DotMotion | None = None) -> None:
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.reset(reference, moved)

    def reset(self, reference: DepthFrame, moved: DotMotion | None = None) -> None:
        """Begin anew with another reference; all keyframes are forgotten."""
        frame = surface_of(reference, "reference")
        slope = float(frame.gradient[0][:, frame.contact[0, 0]].square().mean().sqrt())
        if slope < LEAST_SLOPE_NOISE:
            raise ValueError(f"reference: expected a contact with relief, got slopes of {slope:.2g}: a flat face shows no motion")
        keyframe = make_keyframe(frame, self.mm_per_pixel)
        found = pitch_by_slopes(frame)
        if found <= 0.0:
            raise ValueError(
                "reference: expected slopes of its depth, got others: a gradient of another sign, or of another frame?"
            )
        if not 1.0 / PITCH_RATIO < found / self.mm_per_pixel < PITCH_RATIO:
            raise ValueError(
                f"mm_per_pixel: expected about {found:.3g}, by depth and slopes of the reference, got {self.mm_per_pixel:g}: "
                "another sensor's, or another unit?"
            )
        self.graph = KeyframeGraph(keyframe)
        self.closures: list[tuple[float, float]] = []
        self._size = tuple(frame.depth_mm.shape[-2:])
        self._active = 0
        self._way = [0.0]  # variance that the way from the reference to each keyframe adds up to, as _in_common() has it
        self._least = math.inf  # such a variance, of a frame since the present keyframe was taken up
        self._poses: list[Array] = [np.eye(4)]  # the last two, or the last one
        self._tracking = True
        self._missed: Array | None = None  # the pose that was not taken in the last frame
        self._symmetries: list[Array] = []
        self._symmetries_of_reference: list[Array] | None = None
        self._dots = None if moved is None else points_under(moved, frame.contact)
        self._carried: Array | None = None  # the last pose, moved with the dots
        self._by_dots: Array | None = np.zeros((6, 6))  # covariance of what dots have told since the reference

    def restart(self, T_target_source: Tensor) -> None:
        """Track on from a pose of the reference, (4, 4), such as one that the robot's arm reports."""
        self._poses, self._tracking, self._symmetries = [check_rigid("T_target_source", T_target_source).numpy().copy()], True, []

    def __call__(self, frame: DepthFrame, moved: DotMotion | None = None) -> TrackedPose:
        """Pose of the reference in a frame.

        Args:
            frame: one frame, as the reference.
            moved: motion of the dots in it; None for none.
        Returns:
            The pose; ``lost`` says why there is none.
        Raises:
            TypeError: no DepthOutput.
            ValueError: not one frame.
        """
        try:
            contact = surface_of(frame)
        except Unusable as error:
            return self._lose(error.reason)
        size = tuple(contact.depth_mm.shape[-2:])
        if size != self._size:
            expected = f"expected {self._size[0]} x {self._size[1]} pixels like the reference"
            return self._lose(f"{expected}, got {size[0]} x {size[1]}: of another sensor, or cut out?")
        resolution = self.graph.keyframes[0].resolution
        made = grids(contact, self.mm_per_pixel, resolution)
        if made.touching < LEAST_CELLS:
            return self._lose(f"hardly any contact deeper than {resolution.least_mm:.2g} mm", contact)
        before, self._dots = self._dots, None if moved is None else points_under(moved, contact.contact)
        step = None if before is None or self._dots is None or not self._tracking else carried(before, self._dots)
        if step is None or self._by_dots is None:
            self._carried = self._by_dots = None
        else:
            self._carried = step[0] @ self._poses[-1]
            self._by_dots = moved_covariance(step[0], self._by_dots) + step[1]
        return self._track(contact, made) if self._tracking else self._search(contact, made)

    def _track(self, contact: Surface, frame: Grids) -> TrackedPose:
        """Follow the object from its last pose."""
        last = self._poses[-1]
        starts = [last] if len(self._poses) < 2 else [last, last @ inv(self._poses[0]) @ last]
        older = self._older_keyframe(frame, starts[-1])
        found = self._follow(self._active if older is None else older, frame, starts)
        if older is not None and not self._problem(older, found, starts):
            self._close_loop(older, found, self._follow(self._active, frame, starts), starts)
        elif older is not None:
            found = self._follow(self._active, frame, starts)
        problem = self._problem(self._active, found, starts)
        if problem:
            lost = self._lose(problem, contact)
            self._missed = found.pose @ self.graph.poses[self._active]
            return lost
        return self._accept(contact, frame, found)

    def _follow(self, index: int, frame: Grids, starts: list[Array]) -> Followed:
        """Register to a keyframe; what is unknown follows the dots, unless they contradict what is known: then the object slips."""
        to_reference, keyframe = inv(self.graph.poses[index]), self.graph.keyframes[index]
        poses = [start @ to_reference for start in starts]
        if self._carried is not None:
            expected = self._carried @ to_reference
            found = follow(keyframe, frame, [expected, *poses])
            if distance_mm(keyframe.spread, expected, found.pose) < TRUSTED_MM:
                return found
            self._carried = self._by_dots = None
        return follow(keyframe, frame, poses)

    def _older_keyframe(self, frame: Grids, expected: Array) -> int | None:
        """The oldest keyframe before the present one that has much in common with the frame, and shows its pose no worse."""
        if self._active == 0:
            return None
        _, variance = self._in_common(self._active, frame, expected)
        most = self._way[self._active] + variance
        for k in range(self._active):
            share, variance = self._in_common(k, frame, expected)
            few = HALF * frame.touching < self.graph.keyframes[k].grids.touching
            if few and share > HALF and self._way[k] + variance < most:
                return k
        return None

    def _in_common(self, index: int, frame: Grids, pose: Array) -> tuple[float, float]:
        """:func:`in_common` of a keyframe and a frame, by the pose of the reference in the frame."""
        return in_common(self.graph.keyframes[index], frame, pose @ inv(self.graph.poses[index]))

    def _close_loop(self, older: int, found: Followed, also: Followed, starts: list[Array]) -> None:
        """Link the present keyframe with an older one by a frame that is registered to both, and go on with the older one."""
        if not self._problem(self._active, also, starts):
            back = inv(also.pose)
            covariance = moved_covariance(back, found.covariance + also.covariance)
            twist = self.graph.close(self._active, older, back @ found.pose, covariance)
            middle = twist[3:] + np.cross(twist[:3], self.graph.keyframes[self._active].many.center)
            self.closures.append((math.degrees(float(np.linalg.norm(twist[:3]))), float(np.linalg.norm(middle))))
        self._active, self._least = older, math.inf

    def _problem(self, index: int, found: Followed, starts: list[Array]) -> str:
        """Why a pose cannot be trusted; empty if it can."""
        if found.misfit:
            return f"near the last pose {found.misfit}"
        spread, to_reference = self.graph.keyframes[index].spread, inv(self.graph.poses[index])
        moved = min(distance_mm(spread, found.pose, start @ to_reference) for start in starts)
        if moved > JUMP_MM:
            return f"a jump of {moved:.1f} mm at the contact: another pose may look alike"
        return ""

    def _search(self, contact: Surface, frame: Grids) -> TrackedPose:
        """Search for the object everywhere and near its last pose, by the reference and by the present keyframe."""
        message = "" if len(frame.coarse.pixels()[0]) >= LEAST_CELLS else "hardly any contact"
        for index in dict.fromkeys(() if message else (0, self._active)):
            keyframe, chain = self.graph.keyframes[index], self.graph.poses[index]
            back, spread = inv(chain), self.graph.keyframes[0].spread
            starts = likely_poses(keyframe, frame)
            starts.insert(1, self._poses[-1] @ back)
            motions = [chain @ motion @ back for motion in self._reference_symmetries()]
            equal = equal_poses(keyframe, frame, starts, motions)
            problems = [self._problem(index, one, [one.pose @ chain]) for one in equal]
            equal = [one for one, problem in zip(equal, problems, strict=True) if not problem]
            if not equal:
                message = message or next(iter(problems), follow(keyframe, frame, starts[:1]).misfit)
                continue
            found = min(equal, key=lambda one: distance_mm(spread, one.pose @ chain, self._poses[-1]))
            vaguest = max(equal, key=lambda one: one.free.shape[1])
            if vaguest.free.shape[1] > keyframe.held.shape[1]:
                message = f"it touches, but too little to show its {', '.join(vaguest.names)}"
                continue  # what is unknown now would keep a value of long ago
            if not found.exact and frame.touching < HALF * keyframe.grids.touching:
                message = "it touches with a small part, which other parts of the object may look like"
                continue
            self._symmetries = [inv(found.pose @ chain) @ one.pose @ chain for one in equal if one is not found]
            self._poses = self._on_the_way(found.pose @ chain)
            self._active, self._least, self._tracking = index, math.inf, True
            return self._accept(contact, frame, found)
        return self._lose(f"not found again: {message}", contact)

    def _on_the_way(self, pose: Array) -> list[Array]:
        """The pose before one that a search found, if that lies on an even motion over a single frame that was lost."""
        if self._missed is None:
            return []
        expected = self._missed @ inv(self._poses[-1]) @ self._missed
        return [self._missed] if distance_mm(self.graph.keyframes[0].spread, expected, pose) < JUMP_MM else []

    def _reference_symmetries(self) -> list[Array]:
        """Motions after which the reference looks much the same: continuity is lost, so each of them may have happened."""
        if self._symmetries_of_reference is None:
            self._symmetries_of_reference = symmetries(self.graph.keyframes[0])
        return self._symmetries_of_reference

    def _accept(self, contact: Surface, frame: Grids, found: Followed) -> TrackedPose:
        """Keep a pose, take a keyframe if it is time, and describe the pose."""
        graph, index = self.graph, self._active
        pose = orthonormal(found.pose @ graph.poses[index])
        keyframe, (drift, drift_deg, drift_mm) = graph.keyframes[index], self._drift(found)
        covariance = found.covariance + drift
        if self._carried is not None and self._by_dots is not None:
            pose, covariance = fused(pose, covariance, self._carried, self._by_dots)
        self._poses = [*self._poses[-1:], pose]
        large = frame.touching > HALF * graph.keyframes[0].grids.touching
        grown = HALF * frame.touching > keyframe.grids.touching
        share, variance = in_common(keyframe, frame, found.pose)
        self._least = min(self._least, variance)
        moved_on, vague = large and share < HALF, large and HALF * variance > self._least
        if (grown or moved_on or vague) and found.free.shape[1] <= keyframe.held.shape[1]:  # else what is unknown now would stay so
            self._take_keyframe(contact, found, variance)
        std_deg, std_mm = math.hypot(found.std_deg, drift_deg), math.hypot(found.std_mm, drift_mm)
        exact = found.settled and 3.0 * std_deg <= TRUSTED_DEG and 3.0 * std_mm <= TRUSTED_MM
        message = f"{100 * found.score.fitness:.0f} % of the common contact agrees"
        if found.names:
            by = "kept" if self._by_dots is None else "by the dots"
            message += f"; {by}, because the surface slides on itself: {', '.join(found.names)}"
        if not exact:
            reason = "the way over keyframes adds up" if drift_deg > found.std_deg else "parts of the contact disagree"
            reason = reason if found.settled else "the last step was a large one"
            degrees = f"{std_deg:.1f}" if std_deg < 90.0 else "more than 90"
            message += f"; uncertain by {degrees} degrees and {std_mm:.2f} mm: {reason}"
        return TrackedPose(
            T_target_source=torch.from_numpy(pose.copy()),
            rmse_mm=found.fine.depth_noise,
            fitness=found.score.fitness,
            converged=exact,
            message=message,
            covariance=torch.from_numpy(covariance),
            ambiguous=found.names,
            alternatives=[torch.from_numpy(pose @ other) for other in self._symmetries],
            overlap=found.score.overlap,
            keyframe=index,
            drift_deg=drift_deg,
            drift_mm=drift_mm,
        )

    def _drift(self, found: Followed) -> tuple[Array, float, float]:
        """What the way over keyframes adds: a covariance (6, 6), and standard deviations in degrees and mm."""
        drift = moved_covariance(found.pose, self.graph.covariances[self._active])
        center = found.pose[:3, :3] @ self.graph.keyframes[self._active].many.center + found.pose[:3, 3]
        to_center = np.hstack((-cross(center), np.eye(3)))
        degrees = math.degrees(math.sqrt(float(np.trace(drift[:3, :3]))))
        return drift, degrees, math.sqrt(float(np.trace(to_center @ drift @ to_center.T)))

    def _take_keyframe(self, contact: Surface, found: Followed, variance: float) -> None:
        """Go on with a frame as keyframe, unless it is too faint to be one."""
        try:
            keyframe = make_keyframe(contact, self.mm_per_pixel)
        except ValueError:
            self._least = variance  # a keyframe takes long to make: tried again when the pose is vaguer still
            return
        self._way.append(self._way[self._active] + variance)
        self._active, self._least = self.graph.add(keyframe, self._active, found.pose, found.covariance), math.inf

    def _lose(self, reason: str, contact: Surface | None = None) -> TrackedPose:
        """No pose: the last one, as of no certainty, and the next frame is searched.

        The reason may be that the frame has another pitch, or unit.
        """
        self._tracking, self._missed = False, None
        found = 0.0 if contact is None else pitch_by_slopes(contact)
        if found > 0.0 and not 1.0 / PITCH_RATIO < found / self.mm_per_pixel < PITCH_RATIO:
            pitch = f"depth and slopes of the frame have a pitch of {found:.3g} mm, not {self.mm_per_pixel:g}"
            reason = f"{pitch}: another sensor's, or another unit?"
        unknown = torch.eye(6, dtype=torch.float64) * UNKNOWN_VARIANCE
        last = torch.from_numpy(self._poses[-1].copy())
        return TrackedPose(last, math.inf, 0.0, False, f"lost: {reason}", unknown, overlap=0.0, lost=reason, keyframe=self._active)
