//! Conversions against published vectors (`tests/data/geo`, sources in the rows themselves).

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a test may stop at its first surprise"
)]

use emberfix_frames::{
    Coordinate, Ecef, EllipsoidHeight, Geoid, Metres, MissionEnu, Vector, Vector3, Wgs84,
    Wgs84Parts, ecef_from_enu, enu_from_ecef, place_from_degrees, place_from_ecef,
};

struct Row {
    id: String,
    op: String,
    input: Vector3<f64>,
    reference: Option<Wgs84>,
    output: Vector3<f64>,
    tolerance_m: f64,
}

fn rows() -> Vec<Row> {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/data/geo/golden_vectors.csv"
    );
    let text = std::fs::read_to_string(path).unwrap();
    text.lines().skip(1).map(row).collect()
}

fn row(line: &str) -> Row {
    let fields: Vec<&str> = line.split(',').collect();
    let number = |i: usize| fields[i].parse::<f64>().unwrap();
    let triple = |i: usize| Vector3::new(number(i), number(i + 1), number(i + 2));
    let has_reference = !fields[6].is_empty();
    Row {
        id: fields[0].to_owned(),
        op: fields[1].to_owned(),
        input: triple(3),
        reference: has_reference.then(|| place(triple(6))),
        output: triple(9),
        tolerance_m: number(12),
    }
}

/// Some vectors lie far above any aircraft, so the height check of `place_from_degrees` is passed by.
fn place(lla: Vector3<f64>) -> Wgs84 {
    place_from_degrees(lla.x, lla.y, EllipsoidHeight::from_m(0.0))
        .unwrap()
        .at_height(EllipsoidHeight::from_m(lla.z))
}

fn ecef(metres: Vector3<f64>) -> Coordinate<Ecef> {
    Coordinate::from_metres(metres)
}

/// Difference of two places in metres, as the vectors' notes ask: degrees times 6.4e6 m.
fn lla_difference_m(found: &Wgs84, wanted: Vector3<f64>) -> f64 {
    let metres_per_degree = 6.4e6_f64.to_radians();
    let north = (found.latitude_deg() - wanted.x) * metres_per_degree;
    let turn = (found.longitude_deg() - wanted.y + 540.0).rem_euclid(360.0) - 180.0;
    let east = turn * metres_per_degree * wanted.x.to_radians().cos();
    Vector3::new(east, north, found.height().m() - wanted.z).norm()
}

fn difference_m(row: &Row) -> f64 {
    let origin = row.reference;
    match row.op.as_str() {
        "lla_to_ecef" => {
            (Coordinate::<Ecef>::from_wgs84(&place(row.input)).metres() - row.output).norm()
        }
        "ecef_to_lla" => match place_from_ecef(&ecef(row.input)) {
            Some(found) => lla_difference_m(&found, row.output),
            // Deep in the Earth: refused, not converted.
            None => {
                if row.output.z < -5e6 {
                    0.0
                } else {
                    f64::INFINITY
                }
            }
        },
        "lla_to_enu" => {
            let here = Coordinate::<Ecef>::from_wgs84(&place(row.input));
            let enu = enu_from_ecef::<MissionEnu>(&origin.unwrap()).transform(here);
            (enu.metres() - row.output).norm()
        }
        "enu_to_lla" => {
            let point = Coordinate::<MissionEnu>::from_metres(row.input);
            let found = ecef_from_enu(&origin.unwrap()).transform(point).to_wgs84();
            lla_difference_m(&found, row.output)
        }
        "ecef_to_enu" => {
            let enu = enu_from_ecef::<MissionEnu>(&origin.unwrap()).transform(ecef(row.input));
            (enu.metres() - row.output).norm()
        }
        "enu_to_ecef" => {
            let point = Coordinate::<MissionEnu>::from_metres(row.input);
            (ecef_from_enu(&origin.unwrap()).transform(point).metres() - row.output).norm()
        }
        "ecef_vec_to_enu" => {
            let velocity = Vector::<Ecef>::from_metres(row.input);
            let enu = enu_from_ecef::<MissionEnu>(&origin.unwrap()).transform(velocity);
            (enu.metres() - row.output).norm()
        }
        "enu_vec_to_ecef" => {
            let velocity = Vector::<MissionEnu>::from_metres(row.input);
            (ecef_from_enu(&origin.unwrap()).transform(velocity).metres() - row.output).norm()
        }
        other => panic!("{}: unknown operation {other}", row.id),
    }
}

/// The GRS80 rows differ from WGS84 by 0.1 mm in the polar radius, which is added.
const GRS80_M: f64 = 1.1e-4;

#[test]
fn every_golden_vector_holds_within_its_tolerance() {
    let rows = rows();
    assert_eq!(rows.len(), 123);
    for row in &rows {
        let difference = difference_m(row);
        let limit = row.tolerance_m + GRS80_M;
        assert!(
            difference <= limit,
            "{} {}: {difference:.3e} m > {limit:.3e} m",
            row.id,
            row.op
        );
    }
}

#[test]
fn egm96_agrees_with_the_published_undulations() {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/data/geo/egm96_nga_points.csv"
    );
    let text = std::fs::read_to_string(path).unwrap();
    let geoid = Geoid::new();
    let mut checked = 0;
    for line in text.lines().filter(|line| !line.starts_with('#')).skip(1) {
        let fields: Vec<f64> = line
            .split(',')
            .take(3)
            .map(|field| field.parse().unwrap())
            .collect();
        let found = geoid.undulation(fields[0], fields[1]).m();
        // NGA prints to 1 mm; GeoidEval's grid is interpolated to some centimetres; ours is linear
        // over 2.2 km. Mean sea level for ellipsoid height would be off by up to 100 m.
        assert!((found - fields[2]).abs() < 0.06, "{line}: {found}");
        checked += 1;
    }
    assert_eq!(checked, 13);
}

/// Checklist E4: one step of the printed iteration from height 0 leaves metres at 9 km; ours must
/// not.
#[test]
fn the_printed_height_iteration_is_not_enough_at_nine_kilometres() {
    let (semi_major, e2) = (6_378_137.0_f64, 6.694_379_990_14e-3);
    let wanted = Vector3::new(31.409_422, 119.112_017, 9000.0);
    let x = Coordinate::<Ecef>::from_wgs84(&place(wanted)).metres();
    let p = x.x.hypot(x.y);
    let latitude = (x.z / p / (1.0 - e2)).atan();
    let normal = semi_major / (1.0 - e2 * latitude.sin().powi(2)).sqrt();
    let printed_height = p / latitude.cos() - normal;
    assert!((printed_height - 9000.0).abs() > 10.0, "{printed_height}");
    let ours = place_from_ecef(&ecef(x)).unwrap();
    assert!(lla_difference_m(&ours, wanted) < 1e-6);
}
