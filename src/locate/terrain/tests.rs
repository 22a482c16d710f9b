use super::*;
use crate::locate::View;
use crate::locate::tests::SIGMAS;
use crate::testing::{datum, pose, rig};
use emberfix_frames::{Coordinate, Geoid, Metres, Vector3, Wgs84Parts, place_from_degrees};
use proptest::prelude::*;

const EXACT: TileSigmas = TileSigmas {
    vertical_m: 0.3,
    horizontal_m: 0.0,
    canopy_m: 0.0,
};
/// One arc-second.
const PITCH: f64 = 1.0 / 3600.0;

/// A tile of ellipsoid heights by a function of row and column.
fn parts(
    (north_deg, west_deg): (f64, f64),
    (rows, columns): (usize, usize),
    height: impl Fn(usize, usize) -> f64,
) -> TileParts {
    TileParts {
        name: "made".to_owned(),
        north_deg,
        west_deg,
        row_pitch_deg: PITCH,
        column_pitch_deg: PITCH,
        rows,
        columns,
        heights_m: (0..rows * columns)
            .map(|index| height(index / columns, index % columns) as f32)
            .collect(),
        datum: VerticalDatum::Ellipsoid,
        sigmas: EXACT,
    }
}

fn tiles(parts: impl IntoIterator<Item = TileParts>) -> Tiles {
    Tiles::new(parts.into_iter().map(|p| Tile::new(p).unwrap()).collect()).unwrap()
}

/// 140 x 140 posts (4 km) about the datum of the tests.
fn about_datum(height: impl Fn(usize, usize) -> f64) -> Tiles {
    let north = datum().latitude_deg() + 70.0 * PITCH;
    let west = datum().longitude_deg() - 70.0 * PITCH;
    tiles([parts((north, west), (140, 140), height)])
}

fn place(latitude_deg: f64, longitude_deg: f64) -> Wgs84 {
    place_from_degrees(latitude_deg, longitude_deg, EllipsoidHeight::from_m(0.0)).unwrap()
}

fn known(ground: Ground) -> (f64, f64) {
    match ground {
        Ground::Known { height, sigma_m } => (height.m(), sigma_m),
        other => panic!("{other:?}"),
    }
}

#[test]
fn between_posts_the_ground_is_bilinear() {
    let tiles = tiles([parts((10.0, 20.0), (3, 3), |r, c| (10 * r + c * c) as f64)]);
    let at = |row: f64, column: f64| {
        known(tiles.ground_at(&place(10.0 - row * PITCH, 20.0 + column * PITCH))).0
    };
    assert!((at(1.0, 2.0) - 14.0).abs() < 1e-6);
    assert!((at(0.25, 1.5) - (2.5 + 2.5)).abs() < 1e-6);
    assert!((at(2.0, 0.0) - 20.0).abs() < 1e-6);
}

/// Copernicus tiles end one cell before the next begins, and have fewer columns further north.
#[test]
fn the_cell_between_two_tiles_is_between_the_posts_of_both() {
    let slope = |north: f64, west: f64| {
        move |r: usize, c: usize| {
            1e4 * (north - r as f64 * PITCH - 10.0) + 2e4 * (west + c as f64 * PITCH - 20.0)
        }
    };
    let (south_north, south_west) = (10.0, 20.0);
    let mut northern = parts((10.0 + 5.0 * PITCH, 20.0), (5, 3), |_, _| 0.0);
    northern.column_pitch_deg = 1.5 * PITCH;
    northern.heights_m = (0..15)
        .map(|i| {
            let (r, c) = (i / 3, i % 3);
            (1e4 * (5.0 - f64::from(r)) * PITCH + 2e4 * 1.5 * f64::from(c) * PITCH) as f32
        })
        .collect();
    let eastern = parts(
        (10.0, 20.0 + 4.0 * PITCH),
        (4, 4),
        slope(10.0, 20.0 + 4.0 * PITCH),
    );
    let southern = parts(
        (south_north, south_west),
        (4, 4),
        slope(south_north, south_west),
    );
    let tiles = tiles([southern, eastern, northern]);
    let expected = |north: f64, east: f64| 1e4 * north * PITCH + 2e4 * east * PITCH;
    // In the southern tile, in the seam to the north, in the seam to the east.
    for (north, east) in [(-1.5, 0.3), (0.5, 0.7), (0.25, 2.9), (-2.2, 3.5)] {
        let (found, _) = known(tiles.ground_at(&place(10.0 + north * PITCH, 20.0 + east * PITCH)));
        assert!(
            (found - expected(north, east)).abs() < 1e-3,
            "{north} {east}: {found}"
        );
    }
    // No neighbour: the cell beyond the last posts is not made up.
    for (north, east) in [(-3.5, 1.0), (0.5, 5.5), (-1.0, 7.5), (5.5, 0.5)] {
        let ground = tiles.ground_at(&place(10.0 + north * PITCH, 20.0 + east * PITCH));
        assert_eq!(ground, Ground::OffTiles, "{north} {east}");
    }
}

#[test]
fn a_tile_across_the_antimeridian_is_one_tile() {
    let tiles = tiles([parts((10.0, 180.0 - 2.0 * PITCH), (5, 5), |_, c| c as f64)]);
    for (longitude, expected) in [
        (180.0 - PITCH, 1.0),
        (180.0, 2.0),
        (-180.0, 2.0),
        (-180.0 + 1.5 * PITCH, 3.5),
    ] {
        let (found, _) = known(tiles.ground_at(&place(10.0 - PITCH, longitude)));
        assert!((found - expected).abs() < 1e-5, "{longitude}: {found}");
    }
    let area = Area::around(10.0 - 2.0 * PITCH, 180.0, 30.0);
    assert!(area.west_deg > 0.0 && area.east_deg < 0.0);
    assert!(tiles.covers(&area).is_whole(), "{:?}", tiles.covers(&area));
}

#[test]
fn undulation_over_a_tile_is_that_of_the_model() {
    let mut made = parts((-35.0, 149.0), (900, 900), |_, _| 600.0);
    made.datum = VerticalDatum::Egm96;
    let tiles = tiles([made]);
    for (latitude, longitude) in [(-35.011, 149.013), (-35.19, 149.12), (-35.05, 149.2)] {
        let found = known(tiles.ground_at(&place(latitude, longitude))).0;
        let expected = 600.0 + Geoid::exact(latitude, longitude).m();
        assert!((found - expected).abs() < 0.01, "{found} {expected}");
    }
}

#[test]
fn sigma_grows_with_slope_canopy_and_rough_ground() {
    let with = |sigmas: TileSigmas, height: fn(usize, usize) -> f64| {
        let mut made = parts((0.0, 20.0), (9, 9), height);
        made.sigmas = sigmas;
        known(tiles([made]).ground_at(&place(-4.5 * PITCH, 20.0 + 4.5 * PITCH))).1
    };
    let sigmas = TileSigmas {
        vertical_m: 3.0,
        horizontal_m: 8.0,
        canopy_m: 4.0,
    };
    let level = |_: usize, _: usize| 100.0;
    // 3 m of data and 4 m of canopy.
    assert!((with(sigmas, level) - 5.0).abs() < 1e-6);
    // A post is 30.92 m from the next: 10 m up each is a slope of 0.323, which 8 m of horizontal
    // error turn into 2.587 m.
    let slope = |_: usize, c: usize| 10.0 * c as f64;
    assert!((with(sigmas, slope) - 5.0_f64.hypot(2.587)).abs() < 0.01);
    let rough = |r: usize, c: usize| if (r + c).is_multiple_of(2) { 0.0 } else { 10.0 };
    assert!(with(EXACT, rough) > 6.0);
}

/// Every second post of real tiles predicts those between; the prediction's sigma is honest when the
/// normalised residual has an rms near 1, on smooth hills and in the Alps.
#[test]
fn what_lies_between_posts_of_real_ground_is_in_the_sigma() {
    let folder = std::env::var_os("EMBERFIX_SHARED").map_or_else(
        || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared"),
        std::path::PathBuf::from,
    );
    if !folder.join("data/geo").exists() {
        eprintln!("skipped: no shared data");
        return;
    }
    for (name, middle) in [
        ("S36E149.tif", (-35.5, 149.5)),
        ("N46E008.tif", (46.5, 8.5)),
    ] {
        let near = Area::around(middle.0, middle.1, 25_000.0);
        let window = crate::terrain::geotiff::read(&folder.join("data/geo").join(name), &near)
            .unwrap()
            .unwrap();
        let (rows, columns) = (window.rows / 2, window.columns / 2);
        let mut coarse = parts(
            (window.north_deg, window.west_deg),
            (rows, columns),
            |r, c| f64::from(window.heights_m[2 * r * window.columns + 2 * c]),
        );
        coarse.row_pitch_deg = 2.0 * window.row_pitch_deg;
        coarse.column_pitch_deg = 2.0 * window.column_pitch_deg;
        // Whole metres were stored: 0.29 m of rounding in the posts that are compared.
        coarse.sigmas.vertical_m = 0.29 * 2_f64.sqrt();
        let coarse = tiles([coarse]);
        let (mut sum, mut count) = (0.0, 0);
        for row in (3..2 * rows - 3).step_by(2) {
            for column in (3..2 * columns - 3).step_by(2) {
                let truth = f64::from(window.heights_m[row * window.columns + column]);
                let there = place(
                    window.north_deg - row as f64 * window.row_pitch_deg,
                    window.west_deg + column as f64 * window.column_pitch_deg,
                );
                if let (Ground::Known { height, sigma_m }, false) =
                    (coarse.ground_at(&there), truth.is_nan())
                {
                    sum += ((height.m() - truth) / sigma_m).powi(2);
                    count += 1;
                }
            }
        }
        let rms = (sum / f64::from(count)).sqrt();
        println!("{name}: normalised rms {rms:.2} of {count} posts left out");
        assert!((0.6..1.25).contains(&rms), "{name}: {rms}");
    }
}

fn view_with(test: impl FnOnce(&View<'_>)) {
    let (rig, pose) = (rig(30.0), pose(0.0, 0.0, 0.0));
    test(&View::new(&rig, &pose, &SIGMAS, &datum()));
}

fn direction(azimuth_deg: f64, depression_deg: f64) -> Vector3<f64> {
    let (a, d) = (azimuth_deg.to_radians(), depression_deg.to_radians());
    Vector3::new(a.sin() * d.cos(), a.cos() * d.cos(), -d.sin())
}

/// Height of the ray over the ground.
fn clearance(view: &View<'_>, terrain: &Tiles, ray: &Vector3<f64>, range_m: f64) -> Option<f64> {
    let point = Coordinate::from_metres(view.camera_enu + ray * range_m);
    let there = view.place(&point)?;
    Some(there.height().m() - terrain.height_at(&there)?.m())
}

#[test]
fn each_way_not_to_meet_the_ground_has_its_name() {
    view_with(|view| {
        let here = datum().height().m();
        let meet = |terrain: &Tiles, azimuth, depression| {
            meet_terrain(
                &view.camera_enu,
                &direction(azimuth, depression),
                terrain,
                view,
            )
        };
        let flat = about_datum(|_, _| here - 60.0);
        assert!(
            matches!(meet(&flat, 0.0, 30.0), TerrainHit::Met { range_m, .. }
            if (range_m - 120.0).abs() < 0.1)
        );
        assert_eq!(meet(&flat, 0.0, -5.0), TerrainHit::Above);
        assert!(matches!(
            meet(&flat, 0.0, 0.5),
            TerrainHit::Above | TerrainHit::OffTiles { .. }
        ));
        // 1.8 m above flat ground, 1.5 degrees down: a sine of 0.026.
        let near = about_datum(|_, _| here - 1.8);
        assert_eq!(meet(&near, 0.0, 1.5), TerrainHit::Grazing);
        let high = about_datum(|_, _| here + 5.0);
        assert_eq!(meet(&high, 0.0, 30.0), TerrainHit::Below);
        let holed = about_datum(|r, _| {
            if (60..66).contains(&r) {
                f64::NAN
            } else {
                here - 60.0
            }
        });
        assert!(matches!(meet(&holed, 0.0, 20.0), TerrainHit::Void { range_m } if range_m > 100.0));
        let small = tiles([parts(
            (
                datum().latitude_deg() + 2.0 * PITCH,
                datum().longitude_deg() - 2.0 * PITCH,
            ),
            (5, 5),
            |_, _| here - 60.0,
        )]);
        assert!(
            matches!(meet(&small, 90.0, 20.0), TerrainHit::OffTiles { range_m }
            if (50.0..200.0).contains(&range_m))
        );
    });
}

/// A ridge that a sigma of height lets the ray pass: the fire may be on it or far behind it.
#[test]
fn behind_a_ridge_the_range_is_as_unsure_as_the_ground_behind_it_is_far() {
    view_with(|view| {
        let here = datum().height().m();
        let ridge = |top: f64| {
            about_datum(move |r, _| {
                let from = (f64::from(r as i32) - 60.0) / 5.0;
                here - 60.0 + (30.0 + top) * (-from * from).exp()
            })
        };
        // The ridge is 10 posts of 30.8 m north; a ray of 6 degrees passes 32 m lower there.
        let met =
            |top: f64| meet_terrain(&view.camera_enu, &direction(0.0, 6.0), &ridge(top), view);
        let TerrainHit::Met { sigma_m: sure, .. } = met(15.0) else {
            panic!("{:?}", met(15.0))
        };
        assert!(sure < 20.0, "well below the top: {sure}");
        let tops: Vec<f64> = (0..60).map(|i| -8.0 + 0.2 * f64::from(i)).collect();
        let unsure = tops
            .iter()
            .filter(|top| matches!(met(**top), TerrainHit::Met { sigma_m, .. } if sigma_m > 100.0));
        assert!(
            unsure.count() >= 1,
            "some height of the ridge must be in doubt"
        );
    });
}

/// Rugged ground from a few numbers: waves of several lengths and a cliff.
fn rugged(seed: [f64; 4]) -> impl Fn(usize, usize) -> f64 {
    move |r, c| {
        let (r, c) = (r as f64, c as f64);
        let wave = |length: f64, turn: f64| ((r * turn.cos() + c * turn.sin()) / length).sin();
        let cliff = if r + 0.3 * c < 60.0 + 40.0 * seed[3] {
            30.0
        } else {
            0.0
        };
        datum().height().m() - 90.0
            + 25.0 * wave(9.0, 6.0 * seed[0])
            + 12.0 * wave(3.1, 6.0 * seed[1])
            + 5.0 * wave(1.3, 6.0 * seed[2])
            + cliff
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(96))]
    /// Against 5 cm steps: what the ray passes through before it is said to meet the ground is no
    /// deeper than what the shortest step can hide.
    #[test]
    fn a_ray_meets_rugged_ground_where_brute_force_does(
        seed in prop::array::uniform4(0.0..1.0_f64),
        azimuth in 0.0..360.0_f64,
        depression in 1.0..80.0_f64,
    ) {
        let terrain = about_datum(rugged(seed));
        let ray = direction(azimuth, depression);
        let mut brute = None;
        view_with(|view| {
            let met = meet_terrain(&view.camera_enu, &ray, &terrain, view);
            for step in 0..40_000 {
                let range = 0.05 * f64::from(step);
                match clearance(view, &terrain, &ray, range) {
                    Some(height) if height > 0.0 => {}
                    Some(_) => { brute = Some(range); break; }
                    None => break,
                }
            }
            match (met, brute) {
                (TerrainHit::Met { range_m, .. }, Some(brute)) if (range_m - brute).abs() > 0.06 => {
                    // Only a sliver may be passed: never over a metre deep.
                    assert!(range_m > brute, "{range_m} {brute}");
                    let mut at = brute;
                    while at < range_m - 0.06 {
                        let depth = clearance(view, &terrain, &ray, at).unwrap();
                        assert!(depth > -0.5, "passed {depth} at {at}, met {range_m}, {brute}");
                        at += 0.05;
                    }
                }
                (TerrainHit::Met { range_m, .. }, None) => panic!("made up a meeting at {range_m}"),
                (TerrainHit::Above | TerrainHit::OffTiles { .. } | TerrainHit::Below, Some(brute)) => {
                    panic!("{met:?}, but the ground is met at {brute}")
                }
                _ => {}
            }
        });
    }
}

#[test]
fn shapes_that_no_tile_has_are_refused() {
    let good = || parts((10.0, 20.0), (4, 4), |_, _| 5.0);
    let refused = |change: fn(&mut TileParts)| {
        let mut parts = good();
        change(&mut parts);
        Tile::new(parts).unwrap_err()
    };
    assert!(Tile::new(good()).is_ok());
    assert!(matches!(refused(|p| p.rows = 5), TileError::Size { .. }));
    assert!(matches!(
        refused(|p| p.row_pitch_deg = -PITCH),
        TileError::Pitch { .. }
    ));
    assert!(matches!(
        refused(|p| p.column_pitch_deg = f64::NAN),
        TileError::Pitch { .. }
    ));
    assert!(matches!(
        refused(|p| p.north_deg = 95.0),
        TileError::Extent { .. }
    ));
    assert!(matches!(
        refused(|p| p.west_deg = f64::NAN),
        TileError::Extent { .. }
    ));
    assert!(matches!(
        refused(|p| p.heights_m[6] = -32_768.0),
        TileError::Height {
            row: 1,
            column: 2,
            ..
        }
    ));
    assert!(matches!(
        refused(|p| p.heights_m.fill(f32::NAN)),
        TileError::AllVoid { posts: 16 }
    ));
}
