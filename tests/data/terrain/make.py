"""Cuts a few kilometres out of an SRTM tile and writes them in the shapes that terrain tiles come in.

Needs rasterio (GDAL), which shares no code with emberfix. Run beside this file:
    python make.py ../../../../shared/data/geo/S36E149.tif
"""

import csv
import pathlib
import sys

import numpy as np
import rasterio
from rasterio.transform import from_origin

HERE = pathlib.Path(__file__).parent
# 64 x 48 posts about the airfield of the flight that tests/vehicle.rs replays.
TOP, LEFT, ROWS, COLUMNS = 410, 170, 64, 48
PITCH = 1.0 / 1200.0
VOID = (20, 30)

with rasterio.open(sys.argv[1]) as tile:
    whole = tile.read(1)
    # GDAL's transform is that of pixel corners: half a pixel off the posts.
    north = tile.transform.f + 0.5 * tile.transform.e - TOP * PITCH
    west = tile.transform.c + 0.5 * tile.transform.a + LEFT * PITCH
posts = whole[TOP : TOP + ROWS, LEFT : LEFT + COLUMNS].astype(np.int16)


def write(name, heights, crs="EPSG:4326", area=True, nodata=None, transform=None, void=None, **options):
    heights = heights.copy()
    if void is not None:
        heights[VOID] = void
    with rasterio.open(
        HERE / name,
        "w",
        driver="GTiff",
        height=heights.shape[0],
        width=heights.shape[1],
        count=1,
        dtype=heights.dtype,
        crs=crs,
        transform=transform or from_origin(west - PITCH / 2, north + PITCH / 2, PITCH, PITCH),
        nodata=nodata,
        **options,
    ) as out:
        out.update_tags(AREA_OR_POINT="Area" if area else "Point")
        out.write(heights, 1)


floats = posts.astype(np.float32) + np.float32(0.25)
# 48 columns do not fill two tiles of 32: the last one has padding.
padded = {"tiled": True, "blockxsize": 32, "blockysize": 16}
whole_tiles = {"tiled": True, "blockxsize": 16, "blockysize": 16}
write("int16_strips_point.tif", posts, area=False, nodata=-32767, void=-32767)
write("int16_lzw_horizontal_tiles.tif", posts, compress="lzw", predictor=2, **whole_tiles)
write("float_deflate_floating_tiles_point.tif", floats, area=False, compress="deflate", predictor=3,
      nodata=-9999.0, void=-9999.0, **padded)
write("float_lzw_strips_big_endian.tif", floats, compress="lzw", predictor=1, ENDIANNESS="BIG")
write("egm2008.tif", floats, crs="EPSG:4326+3855", compress="deflate", predictor=2)
write("refused_utm.tif", posts, crs="EPSG:32755", transform=from_origin(688_000, 6_085_000, 90, 90), compress="lzw")
write("refused_feet.tif", (posts * 30).astype(np.int16), compress="lzw")
write("refused_no_place.tif", posts, crs=None, compress="lzw")

with open(HERE / "heights.csv", "w", newline="") as out:
    table = csv.writer(out, lineterminator="\n")
    table.writerow(["latitude_deg", "longitude_deg", "srtm_m"])
    for row, column in [(3.0, 4.0), (10.5, 7.5), (33.3, 12.25), (41.75, 46.999), (0.0, 0.0), (58.9, 0.1)]:
        r, c = int(row), int(column)
        corner = posts[r : r + 2, c : c + 2].astype(float)
        down, right = row - r, column - c
        height = np.array([1 - down, down]) @ corner @ np.array([1 - right, right])
        table.writerow([f"{north - row * PITCH:.10f}", f"{west + column * PITCH:.10f}", f"{height:.4f}"])
print(north, west, posts.min(), posts.max())
