"""The coordinates that the page offers to copy, against GEOTRANS (PyPI `mgrs`) and PROJ."""

import json
import random
import re
import shutil
import subprocess

import mgrs
import pyproj
import pytest

from conftest import HERE

# Exceptions of the grid, edges of bands and zones, both sides of the equator and of the date line.
CORNERS = [
    (60, 5), (63.99, 3.01), (75, 10), (78, 22), (83.99, 41.9), (72, 0.01), (0.001, 0.001), (-0.001, -0.001),
    (-79.99, -179.99), (10, 179.9999), (31.409422, 119.112017), (46.852158, 9.530891),
]  # fmt: skip


@pytest.fixture(scope="module")
def told():
    node = shutil.which("node")
    if not node:
        pytest.skip("no Node")
    seeded = random.Random(7)
    anywhere = [(seeded.uniform(-80, 83.9999), seeded.uniform(-180, 180)) for _ in range(2000)]
    places = CORNERS + anywhere
    run = subprocess.run(
        [node, HERE / "coords_run.mjs"], input=json.dumps(places), capture_output=True, text=True, check=True
    )
    return list(zip(places, json.loads(run.stdout)))


def test_mgrs_names_the_same_square_metre_as_geotrans(told):
    oracle = mgrs.MGRS()
    for (lat, lon), text in told:
        want = re.fullmatch(r"(\d+[A-Z]{3})(\d{5})(\d{5})", oracle.toMGRS(lat, lon).zfill(15))
        got = re.fullmatch(r"(\d\d[A-Z]) ([A-Z]{2}) (\d{5}) (\d{5})", text["mgrs"])
        assert got, text
        assert got[1] + got[2] == want[1], (lat, lon, text)
        # GEOTRANS rounds to a millimetre before it cuts: a place on the line may fall to either side.
        assert abs(int(got[3]) - int(want[2])) <= 1 and abs(int(got[4]) - int(want[3])) <= 1, (lat, lon, text)


def test_utm_is_that_of_proj(told):
    for (lat, lon), text in told:
        zone, easting, northing = re.fullmatch(r"(\d+)[A-Z] (\d+) (\d+)", text["utm"]).groups()
        south = " +south" if lat < 0 else ""
        proj = pyproj.Proj(f"+proj=utm +zone={zone}{south} +ellps=WGS84")
        x, y = proj(lon, lat)
        assert abs(x - int(easting)) <= 0.51 and abs(y - int(northing)) <= 0.51, (lat, lon, text)


def test_degrees_minutes_seconds_read_back(told):
    part = re.compile(r"(\d+)°(\d\d)′(\d\d\.\d\d)″([NSEW])")
    for (lat, lon), text in told:
        read = []
        for degrees, minutes, seconds, side in part.findall(text["dms"]):
            assert int(minutes) < 60 and float(seconds) < 60, text
            size = int(degrees) + int(minutes) / 60 + float(seconds) / 3600
            read.append(-size if side in "SW" else size)
        # Half of the last digit: 0.005 seconds of arc.
        assert read == pytest.approx([lat, lon], abs=0.0051 / 3600), text


def test_where_there_is_no_utm_none_is_made_up():
    node = shutil.which("node")
    if not node:
        pytest.skip("no Node")
    run = subprocess.run(
        [node, HERE / "coords_run.mjs"],
        input="[[84.1, 10], [-80.1, 10]]",
        capture_output=True,
        text=True,
        check=True,
    )
    assert all(text["mgrs"] is None and text["utm"] is None for text in json.loads(run.stdout))
