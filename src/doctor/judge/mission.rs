//! The mission file, and the ground that it flies over.

use super::AtLeast;
use crate::doctor::probe::mission::MissionRead;
use crate::doctor::{Finding, Section, Verdict};
use crate::locate::Terrain;
use crate::mission::{Mission, MissionError};
use emberfix_calib::RigError;
use emberfix_frames::{
    Coordinate, Metres, MissionEnu, Vector3, Wgs84, Wgs84Parts, ecef_from_enu, enu_offset,
    place_from_ecef,
};
use emberfix_report::{Bound, Figure};
use std::path::Path;

/// Radius about the datum, and about the vehicle, in which the ground should be known, metres: what a
/// flight within sight sees.
const AREA_M: f64 = 1_000.0;
/// Step of the grid that is asked for, metres.
const STEP_M: f64 = 50.0;
/// Share of the area whose ground is known.
const COVERAGE: AtLeast = AtLeast {
    good: 0.995,
    usable: 0.5,
};
/// The vehicle further from the datum than this is at another place than the mission, metres.
const FAR_M: (f64, f64) = (3_000.0, 30_000.0);
/// A vehicle that stands on the ground, or flies low, is between these heights above the terrain,
/// metres. A geoid that was mixed up (MSL for ellipsoid) is 10 to 100 m.
const ABOVE_GROUND_M: (f64, f64) = (-10.0, 150.0);

/// The file: what it is, or every problem in it and in its rig.
#[must_use]
pub fn file(path: &Path, read: &MissionRead) -> Section {
    let findings = match &read.mission {
        Ok(mission) => vec![Finding::pass(
            "mission file",
            format!("{}, aircraft {}", mission.name, mission.uav),
        )],
        Err(error) => {
            let mut findings = mission_problems(path, error);
            findings.extend(read.rig.iter().flat_map(rig_problems));
            findings
        }
    };
    Section {
        title: "Mission",
        findings,
    }
}

fn mission_problems(path: &Path, error: &MissionError) -> Vec<Finding> {
    let remedy = format!("put it right in {}", path.display());
    let each = |problem: &String| Finding::fail("mission file", problem.clone(), remedy.clone());
    match error {
        MissionError::Values { problems, .. } => problems.iter().map(each).collect(),
        MissionError::Syntax { message, .. } => vec![each(message)],
        MissionError::Read { source, .. } => vec![Finding::fail(
            "mission file",
            format!("{}: {source}", path.display()),
            "name a mission file, such as missions/gaochun.toml",
        )],
        MissionError::Rig { source, .. } => rig_problems(source),
    }
}

fn rig_problems(error: &RigError) -> Vec<Finding> {
    let fail = |path: &Path, problem: &str| {
        Finding::fail(
            "rig file",
            problem,
            format!(
                "put it right in {}; its keys stand in calib/README.md",
                path.display()
            ),
        )
    };
    match error {
        RigError::Values { path, problems } => {
            problems.iter().map(|problem| fail(path, problem)).collect()
        }
        RigError::Read { path, source } => {
            vec![fail(path, &format!("{}: {source}", path.display()))]
        }
        other => vec![Finding::fail(
            "rig file",
            other.to_string(),
            "put the rig file right; its keys stand in calib/README.md",
        )],
    }
}

/// The ground: known about the datum, known about the vehicle, and not above the vehicle.
#[must_use]
pub fn terrain(mission: &Mission, vehicle: Option<Wgs84>) -> Vec<Finding> {
    let Some(terrain) = &mission.terrain else {
        let mut findings = vec![Finding::warn(
            "terrain",
            "the mission knows no ground",
            "add [terrain] to the mission: without it a far fire seen once has no position",
        )];
        findings.extend(vehicle.map(|place| distance(mission, &place)));
        return findings;
    };
    let mut findings = vec![coverage(terrain.as_ref(), &mission.datum)];
    if let Some(place) = vehicle {
        findings.push(distance(mission, &place));
        findings.extend(above_ground(terrain.as_ref(), &place));
    }
    findings
}

fn coverage(terrain: &dyn Terrain, datum: &Wgs84) -> Finding {
    let heights = sample(terrain, datum);
    let known: Vec<f64> = heights.iter().flatten().copied().collect();
    let share = known.len() as f64 / heights.len().max(1) as f64;
    let (low, high) = known
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), h| {
            (low.min(*h), high.max(*h))
        });
    let value = if known.is_empty() {
        format!("nothing known within {AREA_M:.0} m of the datum")
    } else {
        format!(
            "{:.0} % known within {AREA_M:.0} m of the datum, {}, one sigma {:.1} m",
            100.0 * share,
            span(low, high),
            terrain.sigma_m(datum),
        )
    };
    let remedy = "add the tiles of the mission area: where no ground is known only stereo and flying \
                  past tell the range";
    Finding::of(COVERAGE.judge(share), "terrain", value, remedy).with(Figure::bounded(
        "doctor.terrain_coverage",
        Some(share),
        "",
        Bound::AtLeast(COVERAGE.usable),
        heights.len(),
    ))
}

fn span(low: f64, high: f64) -> String {
    if high - low < 0.5 {
        format!("flat at {low:.1} m above the ellipsoid")
    } else {
        format!("{low:.0} to {high:.0} m above the ellipsoid")
    }
}

fn sample(terrain: &dyn Terrain, datum: &Wgs84) -> Vec<Option<f64>> {
    let steps = (AREA_M / STEP_M) as i32;
    let plane = ecef_from_enu::<MissionEnu>(datum);
    let mut heights = Vec::new();
    for (east, north) in (-steps..=steps).flat_map(|e| (-steps..=steps).map(move |n| (e, n))) {
        let offset = Vector3::new(f64::from(east), f64::from(north), 0.0) * STEP_M;
        if offset.norm() > AREA_M {
            continue;
        }
        let place = place_from_ecef(&plane.transform(Coordinate::from_metres(offset)));
        heights.push(
            place
                .and_then(|place| terrain.height_at(&place))
                .map(|h| h.m()),
        );
    }
    heights
}

fn distance(mission: &Mission, vehicle: &Wgs84) -> Finding {
    let away_m = enu_offset(&mission.datum, vehicle).xy().norm();
    let (far, other) = FAR_M;
    let verdict = match away_m {
        near if near <= far => Verdict::Pass,
        near if near <= other => Verdict::Warn,
        _ => Verdict::Fail,
    };
    let value = format!("the vehicle is {} from the mission's datum", length(away_m));
    let remedy = "is this the mission of today? set [datum] near the place of the flight";
    Finding::of(verdict, "place", value, remedy)
}

fn above_ground(terrain: &dyn Terrain, vehicle: &Wgs84) -> Option<Finding> {
    let ground = terrain.height_at(vehicle)?;
    let above_m = (vehicle.height() - ground).m();
    let (low, high) = ABOVE_GROUND_M;
    let verdict = if (low..=high).contains(&above_m) {
        Verdict::Pass
    } else {
        Verdict::Warn
    };
    let value = format!("GNSS says {above_m:+.1} m above the mission's ground");
    let remedy = "one of the two is wrong: heights in the mission are above the ellipsoid, not above \
                  mean sea level";
    Some(
        Finding::of(verdict, "height", value, remedy).with(Figure::told(
            "doctor.height_above_ground_m",
            Some(above_m),
            "m",
            1,
        )),
    )
}

fn length(metres: f64) -> String {
    if metres < 1_000.0 {
        format!("{metres:.0} m")
    } else {
        format!("{:.1} km", metres / 1_000.0)
    }
}
