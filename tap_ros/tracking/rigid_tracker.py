# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The tracker of this package: clicked objects, followed as rigid bodies.

No learned weights. Each picture is searched around the last pose of each object, on the table or
as high as the hand has lifted it, where camera and hand are known. What the robot hides stays
where it was; what was not found near by is searched everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from tap_ros.base.contract import HIDDEN, LOST, SEEN, UNSURE
from tap_ros.base.errors import TrackingError
from tap_ros.robots.silhouette import PinholeCamera
from tap_ros.tracking.picture import NEAR, Picture
from tap_ros.tracking.plane import EDGE, MIDDLE, Plane, TOP
from tap_ros.tracking.protocols import Tracked, View
from tap_ros.tracking.silhouette import apart, centre, clicked, Cut, share, silhouette, top_face
from tap_ros.tracking.template import APART, Matcher, Pose, SURE, Template

REACH, TURN = 0.05, 0.5  # m, rad, in one control period
REST, REST_TURN = 0.012, 0.1  # the same, of what the hand has not been near to
CARRIED, CARRIED_TURN = 0.03, 0.5  # of what may be carried
HAND_FAR, HAND_HIGH = 0.22, 0.1  # m: a hand farther off, or higher, moves nothing
HAND_HALF = 0.02  # m, half as wide as the fingers are
LIFTED = 0.01  # m, from where on it is above the table
OPEN = 0.95  # opening from which on it holds nothing
HELD = 0.04  # m from the hand to what it holds
GOOD, GOOD_COST = 0.7, 0.35  # fit of what is believed; cost up to which no other is tried
CLEARER = 0.03  # less cost of another than the likeliest pose
DROPPED = 0.1  # less cost of what is not in the hand any more
MOST_COST = 0.4  # of what is found far from where it was
NEW_COST, NEW_ANGLE, NEW_SEEN = 0.25, 0.35, 0.85  # from when on the object is cut out anew
# Weight of the middle of a part of an object beside a click that is so many px off at most.
PART, CLICKED = 0.25, 20.0
UNSURELY = 0.8  # factor of the confidence in an object whose middle is not known
OTHERS = 0.1  # share of other objects in such a cut from which on it is none
WAITS = 4  # pictures from one such cut to the next
BESIDE, SAME = 5, 5  # px around an object, and steps of colour, that say whether anything moved
RECURS = 0.6  # share of the colours of the first template in such a cut
KEYS = 6  # templates of an object, the first among them
BENEATH = 0.1  # m from where an object seems to be that lies on another, to that
KEPT = 0.1  # weight of places where a goal picture shows nothing else
COLOURFUL = 12.0  # contrast from which an object can be followed by its colours alone
MOST = (0.3, 1.8)  # share of its area that has to be there then, from and to
# Confidence in the last place of an object: at once, and the factor of each further picture.
DOUBT = {HIDDEN: (0.88, 0.95), UNSURE: (0.5, 0.9), LOST: (0.5, 0.9)}
PATIENCE = 2  # pictures in which what should be seen may be missed, before it is lost


@dataclass(eq=False)
class _Object:
    """What is known of one object."""

    place: np.ndarray  # (3,) m
    keys: list[Template]  # the first one, and later ones that show other sides
    face: Template  # of its top alone, which looks alike from all sides
    template: Template  # that it was seen by last
    angle: float = 0.0
    state: str = SEEN
    age: int = 0  # pictures since it was seen
    stirred: bool = False  # the hand may have moved it since then
    confidence: float = 1.0
    searched: Picture | None = None  # in which it was found; None: it is not seen
    waits: int = 0  # pictures until it may be cut out anew
    sure: bool = True  # its middle is known, not only a click near it
    part: float = 0.0  # share of its outline that the robot may hide; 0: none

    def nearest(self) -> list[Template]:
        """Return its templates, those first that show it turned like now."""
        return sorted(self.keys, key=self.turned)

    def turned(self, key: Template) -> float:
        """Return by how much it is turned from where a template shows it, rad."""
        return float(np.abs(np.angle(np.exp(1j * (self.angle - key.angle)))))

    def pushed(self, hand: np.ndarray) -> np.ndarray:
        """Return where (3,) m on the table the gripper (2, 4), before and now, has pushed it."""
        way = hand[1, :2] - hand[0, :2]
        length = float(np.linalg.norm(way))
        if hand[:, 2].max() > TOP or not length:
            return self.place
        along, aside = way / length, np.array([-way[1], way[0]]) / length
        points = self.face.placed(self.face.points, self.place, self.angle)[:, :2] - hand[1, :2]
        met = points[np.abs(points @ aside) < HAND_HALF] @ along
        met = met[met > -length - HAND_HALF]  # what is behind the hand stays there
        far = np.clip(HAND_HALF - met.min(initial=HAND_HALF), 0, length)
        return self.place + np.append(along * far, 0)

    def carried(self, hand: np.ndarray) -> list[np.ndarray]:
        """Return where (3,) m it is if the gripper (2, 4) holds it above the table, or nothing."""
        off = self.face.placed(self.face.points, self.place, self.angle) - hand[0, :3]
        held = np.linalg.norm(off[:, :2], axis=1).min() < HELD and off[0, 2] > -TOP
        place = self.place + (hand[1] - hand[0])[:3]
        place[2] *= place[2] > LIFTED
        in_air = self.place[2] or place[2]
        return [place] if held and hand[:, 3].min() < OPEN and in_air else []


class RigidTracker:
    """
    A Tracker, see protocols for what its methods do.

    :param camera: PinholeCamera of any size, or None.
    :param snap: take the middle of the silhouette for the object's, else the click.
    """

    def __init__(self, camera: PinholeCamera | None = None, snap: bool = True) -> None:
        self._camera, self._snap = camera, snap

    def select(self, view: View, pixels: Sequence[Sequence[float]] | np.ndarray,
               drawn: Sequence[np.ndarray] = ()) -> Tracked:
        plane = Plane(self._camera, view.image.shape[:2])
        picture = Picture(view, plane)
        clicks = plane.shrink(np.reshape(pixels, (-1, 2)))
        names = [f'click {tuple(round(float(x), 1) for x in pixel)}'
                 for pixel in plane.enlarge(clicks)]
        cuts = apart(picture, clicks, [clicked(
            picture, click, np.delete(clicks, k, 0), names[k],
            plane.shrink(drawn[k]) if len(drawn) and len(drawn[k]) else None)
            for k, click in enumerate(clicks)])
        objects = [self._object(picture, *one) for one in zip(cuts, clicks)]
        for one, name in zip(objects, names):
            if plane.calibrated and not (np.abs(one.place[:2]) < EDGE).all():
                raise TrackingError(f'{name} is on nothing within {EDGE:g} m of the middle of the '
                                    'table, along x and y; click on an object')
        self._objects, self._plane, self._first = objects, plane, picture
        self._gripper = view.gripper
        return self._tracked()

    def _object(self, picture: Picture, cut: Cut, at: np.ndarray, angle: float = 0.0) -> _Object:
        """Return what is known of an object that was cut out around a pixel."""
        plane = picture.plane
        # Where click and middle contradict each other: half way. Of a part the middle says less.
        way = (0.0 if not self._snap else 1.0 if cut.whole and not cut.touched
               else PART if not cut.whole and cut.off(at) < CLICKED else 0.5)
        middle = plane.places(centre(top_face(cut.mask, plane)))
        place = way * middle + (1 - way) * plane.places(at, MIDDLE)
        first, face = (Template(picture.by(cut.metric), cut.mask, place, angle, top)
                       for top in (False, True))
        return _Object(place, [first], face, first, angle, sure=cut.sure, part=cut.open)

    def update(self, view: View) -> Tracked:
        picture = Picture(view, self._plane, self._first)
        before, self._gripper = self._gripper, view.gripper
        hand = None
        if self._plane.calibrated and before is not None and view.gripper is not None:
            hand = np.stack([before, view.gripper])
        for one in self._objects:
            self._follow(one, picture, hand)
        return self._tracked()

    def find(self, view: View) -> Tracked:
        picture, found = Picture(view, self._plane, self._first), dict[int, Pose]()
        changed = self._first.changed(picture).astype(np.float32)
        region = KEPT + cv2.GaussianBlur(changed, (0, 0), 4)
        faces = [one.face for one in self._objects]
        matchers = {face.metric: Matcher(picture.by(face.metric)) for face in faces}
        for _ in faces:  # the one that fits best first
            avoid = [pose.place for pose in found.values()]
            tried = {k: matchers[face.metric].locate(face, avoid, region, [face.place])
                     for k, face in enumerate(faces) if k not in found}
            best = min(tried, key=lambda k: tried[k].cost)
            found[best] = tried[best]
        over, beneath = [pose for pose in found.values() if pose.confidence > SURE], list[Pose]()
        for k, pose in found.items():
            if pose.confidence <= SURE and self._plane.calibrated:  # its sides may show
                key = self._objects[k].keys[0]
                pose = Matcher(picture.by(key.metric), self._drawn(picture, over)).locate(
                    key, [other.place for other in beneath], region)
                if any(np.linalg.norm(pose.place - other.place) < BENEATH for other in over):
                    found[k] = pose
                    beneath.append(pose)
        poses, plane = [found[k] for k in range(len(faces))], self._plane
        confidence = np.array([pose.confidence for pose in poses])
        places, sure = np.reshape([pose.place for pose in poses], (-1, 3)), confidence > SURE
        return Tracked(
            np.where(sure[:, None], plane.enlarge(plane.pixels(places, MIDDLE)), np.nan),
            tuple(SEEN if one else LOST for one in sure), confidence,
            tuple(plane.enlarge(self._outline(pose)) if one else np.zeros((0, 2))
                  for pose, one in zip(poses, sure)))

    def _follow(self, one: _Object, picture: Picture, hand: np.ndarray | None) -> None:
        """Bring one object into the next picture."""
        picture = picture.by(one.face.metric)
        if one.searched is not None and not one.part and self._still(
                one, one.searched, picture):
            return
        one.searched, one.waits = None, one.waits - 1
        over = [other.place[2] for other in self._objects if other is not one
                and np.linalg.norm((other.place - one.place)[:2]) < APART]
        if over and max(over) > one.place[2] + LIFTED:  # it stays under that
            one.state, one.age, one.confidence = HIDDEN, 0, DOUBT[HIDDEN][0]
            return
        stays = bool(over) or hand is None  # else nothing floats
        guesses, held = [one.place * (1, 1, stays)], False
        if hand is not None:
            lifted = one.carried(hand)
            held = bool(one.place[2] and lifted)
            guesses = [*lifted, *guesses] if one.place[2] else [one.pushed(hand), *lifted]
        one.stirred = bool(one.place[2] or one.age and one.stirred)
        one.place = guesses[0]
        matcher = Matcher(picture, self._covered(one, picture))
        pose = self._search(one, matcher, hand, guesses[1:], held)
        if pose.fit > GOOD:
            one.place, one.angle, one.template = pose.place, pose.angle, pose.template
            one.age, one.confidence = 0, pose.confidence
            one.state = (SEEN if pose.sure else HIDDEN if pose.seen < 0.5 else UNSURE)
            one.searched = picture
            if one.waits <= 0 and not one.place[2] and pose.seen > NEW_SEEN and (
                    one.part or pose.cost > NEW_COST or one.turned(one.nearest()[0]) > NEW_ANGLE):
                self._cut_anew(one, picture)
            return
        key = one.nearest()[0]
        seen = matcher.score(key, one.place[None], np.array([one.angle - key.angle]))[1][0]
        one.age += 1
        one.state = HIDDEN if seen[0] < 0.5 else UNSURE if one.age <= PATIENCE else LOST
        if one.state != HIDDEN and key.contrast > COLOURFUL and not one.place[2]:
            place, amount = matcher.mean_shift(key, one.place)
            if MOST[0] < amount < MOST[1]:  # lifted, or turned to a side not seen before
                one.place, one.state = place, UNSURE
        first, fall = DOUBT[one.state]
        one.confidence = first * fall ** (one.age - 1)

    def _search(self, one: _Object, matcher: Matcher, hand: np.ndarray | None,
                guesses: Sequence[np.ndarray], held: bool) -> Pose:
        """Return the best pose near by, or near guesses where they fit better, else anywhere."""
        grown = 1 + 0.5 * min(one.age, 4)
        reach, turn, keys = REACH * grown, TURN * min(grown, 2), one.nearest()
        others = [(key, one.place) for key in (*keys[1:2], one.face)]
        near = hand is None or bool(((hand[:, 2] < HAND_HIGH) & (
            np.linalg.norm(hand[:, :2] - one.place[:2], axis=1) < HAND_FAR)).any())
        one.stirred |= near
        if not one.stirred and (one.age == 0 or one.state == HIDDEN):
            reach, turn = REST, REST_TURN
        elif hand is not None and near and not held:  # else it is there already
            others.append((keys[0], one.place + (hand[1] - hand[0])[:3] * (1, 1, 0)))
        if guesses:
            reach, turn = CARRIED, CARRIED_TURN
        near_by = (REST, REST_TURN) if held else (reach, turn)  # it moves as the hand does
        best = matcher.refine(keys[0], one.place, one.angle, *near_by)
        if held:
            face = matcher.refine(one.face, one.place, one.angle, *near_by)
            best = face if face.cost < best.cost - CLEARER else best
        for key, place in product((keys[0], one.face), guesses):
            pose = matcher.refine(key, place, one.angle, reach, turn)
            if pose.seen > 0.5 and pose.cost < best.cost - DROPPED * held:
                best = pose
        if best.fit > GOOD and best.cost < GOOD_COST:
            return best
        for key, place in others:
            pose = matcher.refine(key, place, one.angle, reach, turn)
            if pose.cost < best.cost - CLEARER:
                best = pose
        if one.age and best.fit <= GOOD or one.state != SEEN and not best.sure:
            avoid = [other.place for other in self._objects if other is not one]
            pose = matcher.locate(one.face, avoid)
            if (pose.fit > GOOD and pose.cost < min(MOST_COST, best.cost - 0.1)
                    and np.linalg.norm(pose.place - one.place) < 0.08 * (one.age + 1) + 0.03):
                return pose
        return best

    def _covered(self, one: _Object, picture: Picture) -> np.ndarray:
        """Return what hides an object: the robot, and the others where they are seen."""
        return self._drawn(picture, [other for other in self._objects
                                     if other is not one and other.state == SEEN])

    def _foreign(self, one: _Object, picture: Picture) -> np.ndarray:
        """Return what is covered, or has the colours of one not seen whole, and not its own."""
        doubtful = (other for other in self._objects if other.part or other.state != SEEN)
        far, *near = (each.face.palette.distance(picture.by(each.face.metric).index)
                      for each in (one, one, *doubtful))
        return self._covered(one, picture) | (far > NEAR) & (np.min(near, 0) < NEAR)

    def _drawn(self, picture: Picture, others: Sequence[_Object | Pose]) -> np.ndarray:
        """Return the pixels (h, w) bool of the robot and of others."""
        covered = picture.hidden.astype(np.uint8)
        for other in others:
            cv2.fillPoly(covered, [np.rint(self._outline(other)).astype(np.int32)], 1)
        return covered > 0

    def _still(self, one: _Object, before: Picture, now: Picture) -> bool:
        """Return whether two pictures show the same of an object and of what is next to it."""
        outline = self._outline(one)
        u, v = (outline.min(0).astype(int) - BESIDE).clip(0)
        right, low = (outline.max(0).astype(int) + BESIDE).clip(0)
        window = np.s_[v:low, u:right]
        apart = np.asarray(cv2.absdiff(before.lab[window], now.lab[window]))
        return not (before.hidden[window] != now.hidden[window]).any() and (
            apart > SAME).mean() < 0.003

    def _cut_anew(self, one: _Object, picture: Picture) -> None:
        """
        Add a template of the object as it is now: it has turned, and shows other sides.

        An object that was seen in part is replaced by what is seen of it now.
        """
        outline = self._outline(one)
        before = cv2.fillPoly(np.zeros(picture.size, np.uint8), [np.rint(outline).astype(int)], 1)
        if not one.part and share(before, picture.hidden):
            return
        one.waits = WAITS
        at, *others = self._plane.pixels([one.place, *(
            other.place for other in self._objects if other is not one)], MIDDLE)
        radius = 1.4 * float(np.linalg.norm(outline - at, axis=1).max()) + 4
        cut = silhouette(picture, at, others, 0.0 if one.part else radius)
        if one.part:
            if cut.has_more(before > 0, one.part, at) and (
                    cut.mask & self._foreign(one, picture)).sum() < OTHERS * cut.mask.sum():
                self._objects[self._objects.index(one)] = replace(
                    self._object(picture, cut, at, one.angle), state=one.state,
                    confidence=one.confidence, searched=picture, waits=WAITS)
        elif (not share(cut.mask, picture.hidden)
              and 0.6 < cut.mask.sum() / one.keys[0].area < 1.6 and one.keys[0].palette.recurs(
                  picture.index[cut.mask], one.keys[0].indices) > RECURS):
            key = Template(picture, cut.mask, one.place, one.angle)
            one.keys = [one.keys[0], *one.keys[1:][2 - KEYS:], key]

    def _tracked(self) -> Tracked:
        """Return where the objects are."""
        places = np.array([one.place for one in self._objects]).reshape(-1, 3)
        return Tracked(
            self._plane.enlarge(self._plane.pixels(places, MIDDLE)),
            tuple(one.state for one in self._objects),
            np.array([one.confidence * (1.0 if one.sure else UNSURELY) for one in self._objects]),
            tuple(self._plane.enlarge(self._outline(one)) for one in self._objects))

    def _outline(self, one: _Object | Pose) -> np.ndarray:
        return self._plane.pixels(one.template.placed(one.template.outline, one.place, one.angle))
