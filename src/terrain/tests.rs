use super::*;
use crate::locate::{Ground, Terrain};
use emberfix_frames::{EllipsoidHeight, Geoid, Wgs84, place_from_degrees};

const SIGMAS: TileSigmas = TileSigmas {
    vertical_m: 4.0,
    horizontal_m: 0.0,
    canopy_m: 0.0,
};
/// Middle of the tiles in `tests/data/terrain`.
const MIDDLE: (f64, f64) = (-35.365, 149.163);

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/data/terrain")
        .join(name)
}

fn source(path: PathBuf, datum: Option<VerticalDatum>) -> TileSource {
    TileSource {
        paths: vec![path],
        datum,
        sigmas: SIGMAS,
        near: Area::around(MIDDLE.0, MIDDLE.1, 20_000.0),
    }
}

fn egm96(name: &str) -> Tiles {
    load(&source(data(name), Some(VerticalDatum::Egm96))).unwrap()
}

fn place(latitude_deg: f64, longitude_deg: f64) -> Wgs84 {
    place_from_degrees(latitude_deg, longitude_deg, EllipsoidHeight::from_m(0.0)).unwrap()
}

/// Latitude, longitude and what numpy makes of GDAL's posts there.
fn heights_by_gdal() -> Vec<[f64; 3]> {
    let text = std::fs::read_to_string(data("heights.csv")).unwrap();
    let row = |line: &str| {
        let mut numbers = line.split(',').map(|number| number.parse().unwrap());
        std::array::from_fn(|_| numbers.next().unwrap())
    };
    text.lines().skip(1).map(row).collect()
}

#[test]
fn every_layout_gives_the_heights_that_gdal_gives() {
    // The float tiles were written a quarter of a metre higher.
    for (name, lifted_m) in [
        ("int16_strips_point.tif", 0.0),
        ("int16_lzw_horizontal_tiles.tif", 0.0),
        ("float_deflate_floating_tiles_point.tif", 0.25),
        ("float_lzw_strips_big_endian.tif", 0.25),
    ] {
        let tiles = egm96(name);
        for [latitude, longitude, height] in heights_by_gdal() {
            let found = tiles.height_at(&place(latitude, longitude)).unwrap().m();
            let expected = height + lifted_m + Geoid::exact(latitude, longitude).m();
            // 1 cm for the lattice of undulations; 0.1 mm for the places' ten decimals.
            assert!(
                (found - expected).abs() < 0.011,
                "{name} at {latitude} {longitude}: {found} m, expected {expected} m"
            );
        }
    }
}

#[test]
fn a_declared_void_is_a_void_in_the_four_cells_around_it_and_nowhere_else() {
    let pitch = 1.0 / 1200.0;
    let (north, west) = (-35.341_666_666_666_67, 149.141_666_666_666_68);
    for name in [
        "int16_strips_point.tif",
        "float_deflate_floating_tiles_point.tif",
    ] {
        let tiles = egm96(name);
        let at = |row: f64, column: f64| {
            tiles.ground_at(&place(north - row * pitch, west + column * pitch))
        };
        for (row, column) in [(19.5, 29.5), (20.5, 30.5), (20.0, 30.0), (19.01, 30.0)] {
            assert_eq!(at(row, column), Ground::Void, "{name} {row} {column}");
        }
        for (row, column) in [(18.99, 30.0), (21.01, 30.5), (20.0, 31.01)] {
            assert!(
                matches!(at(row, column), Ground::Known { .. }),
                "{name} {row} {column}"
            );
        }
        assert_eq!(at(-1.0, 3.0), Ground::OffTiles);
        assert_eq!(at(3.0, 47.5), Ground::OffTiles);
    }
}

fn refusal(name: &str, datum: Option<VerticalDatum>) -> String {
    let problems = load(&source(data(name), datum)).unwrap_err();
    assert_eq!(problems.len(), 1, "{problems:?}");
    let line = problems[0].to_string();
    assert!(!line.contains('\n') && line.contains(name), "{line}");
    line
}

#[test]
fn what_is_no_tile_is_refused_in_one_line_that_says_why() {
    let egm96 = Some(VerticalDatum::Egm96);
    for (name, datum, why) in [
        ("refused_utm.tif", egm96, "GTModelType is 1"),
        ("refused_feet.tif", egm96, "another unit"),
        ("refused_no_place.tif", egm96, "has no GeoKeyDirectory"),
        ("heights.csv", egm96, "signature"),
        ("int16_strips_point.tif", None, "set vertical_datum"),
        (
            "egm2008.tif",
            egm96,
            "heights count from egm2008, vertical_datum says egm96",
        ),
        ("nowhere.tif", egm96, "No such file"),
    ] {
        let line = refusal(name, datum);
        assert!(line.contains(why), "{name}: {line}");
    }
}

#[test]
fn every_problem_of_a_folder_is_told_at_once() {
    let problems = load(&source(data("."), Some(VerticalDatum::Egm96))).unwrap_err();
    assert_eq!(problems.len(), 4, "{problems:?}");
    let empty = tempfile::tempdir().unwrap();
    let problems = load(&source(empty.path().to_owned(), None)).unwrap_err();
    assert!(problems[0].to_string().contains("holds no .tif"));
}

#[test]
fn egm2008_heights_carry_the_difference_of_the_geoids_in_their_sigma() {
    let tiles = load(&source(data("egm2008.tif"), None)).unwrap();
    let [latitude, longitude, height] = heights_by_gdal()[0];
    let here = place(latitude, longitude);
    let expected = height + 0.25 + Geoid::exact(latitude, longitude).m();
    assert!((tiles.height_at(&here).unwrap().m() - expected).abs() < 0.011);
    let other = egm96("float_lzw_strips_big_endian.tif");
    let (with, without) = (tiles.sigma_m(&here), other.sigma_m(&here));
    assert!(
        (with.powi(2) - without.powi(2) - 1.0).abs() < 1e-6,
        "{with} {without}"
    );
}

#[test]
fn only_what_lies_near_is_kept() {
    let mut source = source(
        data("int16_lzw_horizontal_tiles.tif"),
        Some(VerticalDatum::Egm96),
    );
    source.near = Area::around(-35.365, 149.163, 300.0);
    let tiles = load(&source).unwrap();
    let [latitude, longitude] = [-35.366, 149.162];
    let whole = egm96("int16_lzw_horizontal_tiles.tif");
    let here = place(latitude, longitude);
    let (few, all) = (
        tiles.height_at(&here).unwrap(),
        whole.height_at(&here).unwrap(),
    );
    assert!((few.m() - all.m()).abs() < 0.011);
    assert!(tiles.covers(&source.near).is_whole());
    assert!(
        tiles
            .covers(&Area::around(-35.365, 149.163, 3_000.0))
            .off_tiles
            > 0.8
    );
    source.near = Area::around(46.0, 8.0, 20_000.0);
    let problems = load(&source).unwrap_err();
    assert!(
        matches!(problems[..], [TerrainError::Elsewhere { files: 1, .. }]),
        "{problems:?}"
    );
}

#[test]
fn a_cut_off_or_damaged_file_is_refused_or_read_and_nothing_panics() {
    let file = tempfile::Builder::new().suffix(".tif").tempfile().unwrap();
    let source = source(file.path().to_owned(), Some(VerticalDatum::Egm96));
    let whole = std::fs::read(data("int16_lzw_horizontal_tiles.tif")).unwrap();
    for length in (0..whole.len()).step_by(61) {
        std::fs::write(file.path(), &whole[..length]).unwrap();
        assert!(load(&source).is_err(), "{length} bytes");
    }
    for at in (0..whole.len()).step_by(7) {
        let mut damaged = whole.clone();
        damaged[at] ^= 0xff;
        std::fs::write(file.path(), &damaged).unwrap();
        let _ = load(&source);
    }
}

/// Heights at known places of the two SRTM tiles that the project keeps beside it.
#[test]
fn srtm_tiles_have_their_known_heights() {
    let folder = std::env::var_os("EMBERFIX_SHARED").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        PathBuf::from,
    );
    let tile = |name: &str, middle: (f64, f64)| {
        let mut source = source(
            folder.join("data/geo").join(name),
            Some(VerticalDatum::Egm96),
        );
        source.near = Area::around(middle.0, middle.1, 15_000.0);
        load(&source).unwrap()
    };
    if !folder.join("data/geo").exists() {
        eprintln!("skipped: no shared data");
        return;
    }
    let above_sea = |tiles: &Tiles, latitude: f64, longitude: f64| {
        tiles.height_at(&place(latitude, longitude)).unwrap().m()
            - Geoid::exact(latitude, longitude).m()
    };
    let canberra = tile("S36E149.tif", (-35.32, 149.13));
    // Bilinear between the four posts as GDAL reads them. The nearest posts say 586, 810 and 2698 m.
    assert!((above_sea(&canberra, -35.3630, 149.1645) - 583.84).abs() < 0.02);
    assert!((above_sea(&canberra, -35.2745, 149.097_52) - 807.84).abs() < 0.02);
    let alps = tile("N46E008.tif", (46.854_539, 8.497_01));
    let height = above_sea(&alps, 46.854_539, 8.497_01);
    assert!((height - 2702.10).abs() < 0.02, "{height}");
}
