"""The geodesy oracle against published values and against itself."""

import csv
import json
import math

import pytest
from conftest import start


def ask(*requests, ellipsoid="WGS84"):
    process = start("geo_oracle", "--ellipsoid", ellipsoid)
    out, err = process.communicate("\n".join(map(json.dumps, requests)) + "\n", timeout=60)
    assert process.returncode == 0, err
    return [json.loads(line) for line in out.splitlines()]


def test_known_places():
    equator, pole = ask(
        {"op": "lla_to_ecef", "lat": 0, "lon": 90, "h": 100},
        {"op": "lla_to_ecef", "lat": -90, "lon": 0, "h": 0, "id": "south"},
    )
    assert [equator[k] for k in "xyz"] == pytest.approx([0, 6_378_237, 0], abs=1e-8)
    assert [pole[k] for k in "xyz"] == pytest.approx([0, 0, -6_356_752.314245], abs=1e-6)
    assert pole["id"] == "south"


def test_east_is_east():
    origin = {"lat0": 31.4, "lon0": 119.1, "h0": 20}
    (enu,) = ask({"op": "lla_to_enu", **origin, "lat": 31.4, "lon": 119.101, "h": 20})
    assert enu["e"] == pytest.approx(95.1, abs=0.1)
    assert abs(enu["n"]) < 0.01 and abs(enu["u"]) < 0.01


def test_there_and_back():
    origin = {"lat0": -89.9, "lon0": 179.9, "h0": -30}
    (ecef,) = ask({"op": "enu_to_ecef", **origin, "e": 100, "n": -200, "u": 50})
    (enu,) = ask({"op": "ecef_to_enu", **origin, **{k: ecef[k] for k in "xyz"}})
    assert [enu[k] for k in "enu"] == pytest.approx([100, -200, 50], abs=1e-7)


def test_geodesics():
    (line,) = ask({"op": "inverse", "lat1": 0, "lon1": 0, "lat2": 0, "lon2": 1})
    assert line["distance"] == pytest.approx(111_319.4908, abs=1e-4)
    assert line["azimuth1"] == pytest.approx(90) and line["azimuth2"] == pytest.approx(90)


def test_a_bad_request_is_answered():
    assert "error" in ask({"op": "lla_to_ecef", "lat": 1})[0]


def test_golden_vectors(shared):
    """Two hands wrote these: PROJ's own tests and others; each says its tolerance."""
    with open(shared / "geo" / "golden_vectors.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["op"] in OPERATIONS]
    for ellipsoid in ("WGS84", "GRS80"):
        here = [row for row in rows if row["ellipsoid"] == ellipsoid]
        assert len(here) > 10
        answers = ask(*map(request, here), ellipsoid=ellipsoid)
        for row, answer in zip(here, answers, strict=True):
            assert off_by_m(row, answer) <= float(row["tol_m"]), (row, answer)


def request(row):
    inputs, _ = OPERATIONS[row["op"]]
    values = {name: row[f"in{i}"] for i, name in enumerate(inputs, start=1)}
    origin = {"lat0": row["ref_lat_deg"], "lon0": row["ref_lon_deg"], "h0": row["ref_h_m"]}
    return {"op": row["op"], **origin, **values}


def off_by_m(row, answer):
    """The greatest difference along one axis, in metres; at a pole any longitude is right."""
    _, outputs = OPERATIONS[row["op"]]
    expected = [float(row[f"out{i}"]) for i in (1, 2, 3)]
    difference = [answer[name] - value for name, value in zip(outputs, expected, strict=True)]
    if outputs == LLA:
        difference[0] *= METRES_PER_DEGREE
        turn = (difference[1] + 180) % 360 - 180
        difference[1] = turn * METRES_PER_DEGREE * math.cos(math.radians(expected[0]))
    return max(map(abs, difference))


METRES_PER_DEGREE = 111_320
LLA, ECEF, ENU = ("lat", "lon", "h"), ("x", "y", "z"), ("e", "n", "u")
OPERATIONS = {
    "lla_to_ecef": (LLA, ECEF),
    "ecef_to_lla": (ECEF, LLA),
    "lla_to_enu": (LLA, ENU),
    "ecef_to_enu": (ECEF, ENU),
    "enu_to_lla": (ENU, LLA),
    "enu_to_ecef": (ENU, ECEF),
}
