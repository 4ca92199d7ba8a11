"""Norm, tilt and speed: worked by hand, tangents that contain the cone, and the way back into it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.safety.cone import G_M_S2, Cone, norm_cone, speed_cone, tilt_cone

CONES = [norm_cone(2.5), tilt_cone(20.0), tilt_cone(50.0), speed_cone(np.array([3.0, -2.0, 1.0]), 3.5, 0.2)]
POINTS = np.random.default_rng(0).uniform(-8.0, 8.0, (400, 3))


def test_excess_by_hand() -> None:
    assert norm_cone(3.0).excess(np.array([[0.0, 4.0, 3.0], [0.0, 0.0, -1.0]])) == pytest.approx([2.0, -2.0])
    tilt = tilt_cone(45.0)  # |(a_x, a_y)| <= a_z + g, as a distance: over the square root of 2
    assert tilt.excess(np.array([3.0, 4.0, 5.0 - G_M_S2])) == pytest.approx(0.0)
    assert tilt.excess(np.array([G_M_S2 + 2.0, 0.0, 0.0])) == pytest.approx(math.sqrt(2.0))
    speed = speed_cone(np.array([1.0, 0.0, 0.0]), 2.0, 0.5)
    assert speed.excess(np.array([2.5, 0.0, 0.0])) == pytest.approx(0.5)
    assert (norm_cone(1.0).name, tilt.name, speed.name) == ("norm", "tilt", "speed")


def test_tilt_is_the_angle_of_the_thrust() -> None:
    inside = tilt_cone(30.0).excess(POINTS) <= 0.0
    thrust = POINTS + np.array([0.0, 0.0, G_M_S2])
    angle = np.degrees(np.arctan2(np.hypot(thrust[:, 0], thrust[:, 1]), thrust[:, 2]))
    assert (inside == (angle <= 30.0)).all()
    assert 0 < inside.sum() < len(inside)


@pytest.mark.parametrize("cone", CONES)
def test_the_distance_is_to_the_surface(cone: Cone) -> None:
    """Along the tangent's normal the excess changes by as much as one goes."""
    for a in POINTS[:40]:
        normal, _ = cone.tangent(a)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        step = 1e-5
        slope = (float(cone.excess(a + step * normal)) - float(cone.excess(a - step * normal))) / (2.0 * step)
        assert slope == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.parametrize("cone", CONES)
def test_a_tangent_contains_the_cone_and_touches_it(cone: Cone) -> None:
    inside = POINTS[cone.excess(POINTS) <= 0.0]
    assert len(inside)
    for a in POINTS[:40]:
        normal, floor = cone.tangent(a)
        assert (inside @ normal >= floor - 1e-12).all()
        assert float(normal @ a - floor) == pytest.approx(-float(cone.excess(a)), abs=1e-9)


def test_at_the_axis_a_tangent_points_east() -> None:
    normal, floor = norm_cone(2.0).tangent(np.zeros(3))
    assert normal.tolist() == [-1.0, 0.0, 0.0]
    assert floor == -2.0


@pytest.mark.parametrize("cone", CONES)
def test_the_share_ends_on_the_surface_or_at_the_goal(cone: Cone) -> None:
    inside = next(a for a in POINTS if cone.excess(a) < -0.1)
    share = cone.share(inside, POINTS)
    assert ((share >= 0.0) & (share <= 1.0)).all()
    reached = inside + share[:, None] * (POINTS - inside)
    excess, goal = cone.excess(reached), cone.excess(POINTS)
    assert share[goal <= 0.0] == pytest.approx(1.0)
    assert excess[goal > 1e-6] == pytest.approx(0.0, abs=1e-9)


def test_from_the_surface_itself_the_way_out_has_no_share_and_the_way_in_all() -> None:
    share = norm_cone(2.0).share(np.array([2.0, 0.0, 0.0]), np.array([[3.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    assert share.tolist() == [0.0, 1.0]


def test_shares_by_hand() -> None:
    assert norm_cone(0.5).share(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, -0.4, 0.0]])).tolist() == [0.5, 1.0]
    tilt = tilt_cone(45.0)  # from hover sideways the edge is g away, and as far when sinking by half of it
    assert tilt.share(np.zeros(3), np.array([[0.0, 2.0 * G_M_S2, 0.0]])) == pytest.approx([0.5])
    assert tilt.share(np.zeros(3), np.array([[0.0, G_M_S2, -G_M_S2]])) == pytest.approx([0.5])


def test_from_a_point_outside_no_way_leads_further_out() -> None:
    share = norm_cone(2.0).share(np.array([2.1, 0.0, 0.0]), np.array([[3.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    assert share.tolist() == [0.0, 1.0]


def test_a_nanometre_per_second_squared_from_the_axis_is_on_it() -> None:
    assert norm_cone(2.0).tangent(np.array([0.0, 1e-9, 0.0]))[0].tolist() == [-1.0, 0.0, 0.0]
    assert norm_cone(2.0).tangent(np.array([0.0, 1e-8, 0.0]))[0].tolist() == [0.0, -1.0, 0.0]


@pytest.mark.parametrize("cone", [norm_cone(2.5), tilt_cone(20.0)])
def test_a_shrunk_cone_leaves_room_for_the_worst_corner(cone: Cone) -> None:
    small = cone.shrunk(0.3)
    surface = POINTS[cone.excess(POINTS) > 0.0]
    edge = small.share(np.zeros(3), surface)[:, None] * surface
    corners = 0.3 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    worst = max(float(cone.excess(edge + corner).max()) for corner in corners)
    assert -0.1 < worst <= 1e-9
    assert cone.shrunk(9.0).radius == 0.0


def test_reach_is_the_shortest_way_out() -> None:
    assert norm_cone(2.5).reach == 2.5
    assert tilt_cone(30.0).reach == pytest.approx(G_M_S2 * 0.5)
