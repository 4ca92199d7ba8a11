"""WGS84 to a tangent plane: against the published examples, against radii of curvature, and there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.link.geo import TangentPlane, ecef, geodetic_from_ecef


def dms(degrees: float, minutes: float, seconds: float) -> float:
    return degrees + minutes / 60.0 + seconds / 3600.0


# IOGP guidance note 7-2, examples of methods 9602 (geographic/geocentric) and 9837 (geographic/topocentric), WGS84
POINT = dms(53, 48, 33.820), dms(2, 7, 46.380), 73.0
POINT_ECEF = 3771793.968, 140253.342, 5124304.349
ORIGIN = TangentPlane(55.0, 5.0, 200.0)
POINT_ENU = -189013.869, -128642.040, -4220.171


def test_the_published_geocentric_example() -> None:
    np.testing.assert_allclose(ecef(*POINT), POINT_ECEF, atol=1e-3)
    lat_deg, lon_deg, alt_m = geodetic_from_ecef(*POINT_ECEF)
    assert lat_deg == pytest.approx(POINT[0], abs=1e-8)
    assert lon_deg == pytest.approx(POINT[1], abs=1e-8)
    assert alt_m == pytest.approx(73.0, abs=2e-3)


def test_the_published_topocentric_example() -> None:
    np.testing.assert_allclose(ORIGIN.enu(*POINT), POINT_ENU, atol=2e-3)
    lat_deg, lon_deg, alt_m = ORIGIN.geodetic(np.array(POINT_ENU))
    assert (lat_deg, lon_deg) == pytest.approx(POINT[:2], abs=1e-8)
    assert alt_m == pytest.approx(73.0, abs=2e-3)


@pytest.mark.parametrize("lat_deg", [-89.999, -60.0, -0.001, 0.0, 33.0, 47.397742, 89.9])
def test_near_the_origin_the_radii_of_curvature_tell(lat_deg: float) -> None:
    """North by the meridional radius, east by that of the parallel; textbook formulas, not ours."""
    a, e2, sin2 = 6378137.0, 0.00669437999014, math.sin(math.radians(lat_deg)) ** 2
    meridian = a * (1.0 - e2) / (1.0 - e2 * sin2) ** 1.5
    parallel = a / math.sqrt(1.0 - e2 * sin2) * math.cos(math.radians(lat_deg))
    step_deg = 1e-5
    east, north, up = TangentPlane(lat_deg, 8.5, 0.0).enu(lat_deg + step_deg, 8.5 + step_deg, 3.0)
    assert north == pytest.approx(math.radians(step_deg) * meridian, rel=1e-4, abs=1e-4)
    assert east == pytest.approx(math.radians(step_deg) * parallel, rel=1e-4, abs=1e-4)
    assert up == pytest.approx(3.0, abs=1e-6)


def test_there_and_back_everywhere() -> None:
    rng = np.random.default_rng(1)
    for _ in range(500):
        lat_deg, lon_deg, alt_m = rng.uniform(-90, 90), rng.uniform(-180, 180), rng.uniform(-500, 9000)
        plane = TangentPlane(lat_deg, lon_deg, alt_m)
        p_enu = rng.normal(scale=2e4, size=3)
        np.testing.assert_allclose(plane.enu(*plane.geodetic(p_enu)), p_enu, atol=1e-7)
    pole = TangentPlane(90.0, 0.0, 0.0)
    assert pole.geodetic(np.array([0.0, 0.0, 5.0])) == pytest.approx((90.0, 0.0, 5.0), abs=1e-6)


def test_the_antimeridian_is_no_border() -> None:
    east, north, up = TangentPlane(0.0, 179.9999, 0.0).enu(0.0, -179.9999, 0.0)
    assert east == pytest.approx(math.radians(0.0002) * 6378137.0, abs=1e-3)
    assert (north, up) == pytest.approx((0.0, 0.0), abs=1e-3)
