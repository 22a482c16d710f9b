//! Flights in numbers: what was put in is found, and what cannot be found is said.

use super::model::{Model, N, Parameters, mount_of};
use super::{
    BodyAt, Parameter, Sight, Solution, SolveError, Start, Wandering, Way, observability, solve,
};
use crate::testing::rig;
use emberfix_calib::Eye;
use emberfix_frames::{
    Attitude, CamLeftRaw, Matrix3, MountAngles, ServiceTime, UnitQuaternion, Vector3,
    body_from_camera, rotation_matrix,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Where the airframe is at a time: position east, north, up; roll, pitch, heading.
type Path = fn(f64) -> (Vector3<f64>, [f64; 3]);

/// A circle of 15 m about the marker, at 10 m, to the right or to the left.
fn circle(t_s: f64, way: f64) -> (Vector3<f64>, [f64; 3]) {
    let azimuth = way * 5.0 / 15.0 * t_s;
    let position = Vector3::new(azimuth.sin() * 15.0, azimuth.cos() * 15.0, 10.0);
    (position, [0.0, 0.0, azimuth + std::f64::consts::PI])
}

/// Weaving round the marker, nearer and farther, with gusts: it wanders all over the picture.
fn weaving(t_s: f64) -> (Vector3<f64>, [f64; 3]) {
    let wave = |size: f64, period: f64| size * (std::f64::consts::TAU * t_s / period).sin();
    let (mut position, [_, _, heading]) = circle(t_s, 1.0);
    position *= 1.0 + wave(0.35, 17.0);
    let angles = [wave(0.08, 2.3), wave(0.08, 3.1), heading + wave(0.5, 5.7)];
    (position, angles)
}

/// The same without a gust: heading and mount turn about the same axis.
fn level(t_s: f64) -> (Vector3<f64>, [f64; 3]) {
    let (position, [_, _, heading]) = weaving(t_s);
    (position, [0.0, 0.0, heading])
}

fn to_the_right(t_s: f64) -> (Vector3<f64>, [f64; 3]) {
    circle(t_s, 1.0)
}

fn hover(_: f64) -> (Vector3<f64>, [f64; 3]) {
    (Vector3::new(0.0, -15.0, 10.0), [0.0, 0.0, 0.0])
}

fn body((position_m, [roll, pitch, heading]): (Vector3<f64>, [f64; 3])) -> BodyAt {
    let attitude = Attitude::from_angles(roll, pitch, heading);
    let enu_from_body = rotation_matrix(&attitude.enu_from_body());
    BodyAt {
        position_m,
        enu_from_body: super::model::quaternion(&enu_from_body),
    }
}

fn start(surveyed: bool) -> Start {
    let rig = rig(30.0);
    let mut sigmas = Parameters::from_element(0.175);
    let set = [
        (Parameter::Arm, 3, 0.02),
        (Parameter::Clock, 1, 0.3),
        (Parameter::Heading, 1, 0.002),
        (Parameter::Tilt, 2, 0.002),
        (Parameter::Gnss, 3, 0.03),
        (Parameter::Marker, 3, if surveyed { 0.02 } else { 1e4 }),
    ];
    for (first, count, sigma) in set {
        for axis in 0..count {
            sigmas[first as usize + axis] = sigma;
        }
    }
    Start {
        camera: rig.camera(Eye::Left).clone(),
        body_from_camera: rotation_matrix(&body_from_camera::<CamLeftRaw>(rig.mount())),
        rectified_from_raw: *rig.rectification().rectified_from_raw(Eye::Left),
        arm_m: Vector3::zeros(),
        marker_m: surveyed.then(Vector3::zeros),
        sigmas,
        wandering: [STILL; 6],
    }
}

/// What does not wander.
const STILL: Wandering = Wandering {
    sigma: 0.0,
    correlation_s: 100.0,
};

/// Three degrees in all, and 300 ms.
fn truth() -> Parameters {
    let mut x = Parameters::zeros();
    x[Parameter::MountRoll as usize] = 1.2_f64.to_radians();
    x[Parameter::MountPitch as usize] = -2.0_f64.to_radians();
    x[Parameter::MountYaw as usize] = 1.9_f64.to_radians();
    x[Parameter::Clock as usize] = 0.3;
    x
}

fn noise(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random_range(-0.5..0.5)).sum()
}

fn fly(path: Path, seed: u64, sigma_px: f64) -> Vec<Sight> {
    let (begin, mut rng) = (start(true), ChaCha8Rng::seed_from_u64(seed));
    let sights = (0..160).filter_map(|k| {
        let t_s = f64::from(k) * 0.375;
        let way = Way {
            from_s: -0.6,
            step_s: 0.02,
            time_sigma_s: 0.0,
            bodies: (0..61)
                .map(|step| body(path(t_s - 0.6 + 0.02 * f64::from(step))))
                .collect(),
        };
        let mut sight = Sight {
            at: ServiceTime::from_unix_ns((t_s * 1e9) as i64),
            pixel: emberfix_calib::RawPixel { u: 0.0, v: 0.0 },
            sigma_px,
            way,
            stereo: None,
        };
        let seen = Model::new(&begin, &truth()).predict(&sight.way)?;
        let inside = (0.0..1280.0).contains(&seen.u) && (0.0..720.0).contains(&seen.v);
        sight.pixel.u = seen.u + sigma_px * noise(&mut rng);
        sight.pixel.v = seen.v + sigma_px * noise(&mut rng);
        inside.then_some(sight)
    });
    sights.collect()
}

fn boresight_error_deg(solution: &Solution) -> f64 {
    let turn = |x: &Parameters| -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(Vector3::new(x[0], x[1], x[2]))
    };
    turn(&solution.parameters)
        .angle_to(&turn(&truth()))
        .to_degrees()
}

#[test]
fn three_degrees_and_300_ms_are_found_with_a_surveyed_marker() {
    for seed in 0..5 {
        let sights = fly(weaving, seed, 1.0);
        assert!(sights.len() > 100, "{} sights", sights.len());
        let solution = solve(&start(true), &sights).unwrap();
        let error_deg = boresight_error_deg(&solution);
        assert!(error_deg < 0.1, "{error_deg} degrees");
        let clock_ms = (solution.clock_s() - 0.3).abs() * 1e3;
        assert!(clock_ms < 5.0, "{clock_ms} ms");
        assert_eq!(solution.outliers, 0);
    }
}

#[test]
fn the_truth_is_within_the_stated_sigmas() {
    let (mut within, mut all) = (0, 0);
    for seed in 0..20 {
        let solution = solve(&start(true), &fly(weaving, 100 + seed, 1.0)).unwrap();
        for index in [0, 1, 2, 6] {
            let error = (solution.parameters[index] - truth()[index]).abs();
            within += usize::from(error < 2.0 * solution.sigma(index));
            all += 1;
        }
    }
    // 95 % of 80 is 76; five fewer than that happens once in a hundred.
    assert!(within >= 71, "{within} of {all} within two sigma");
}

#[test]
fn a_third_of_wrong_picks_does_no_harm() {
    let mut sights = fly(weaving, 7, 1.0);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for sight in sights.iter_mut().step_by(3) {
        sight.pixel.u = rng.random_range(0.0..1280.0);
        sight.pixel.v = rng.random_range(0.0..720.0);
    }
    let solution = solve(&start(true), &sights).unwrap();
    assert!(boresight_error_deg(&solution) < 0.1);
    assert!((solution.clock_s() - 0.3).abs() < 0.005);
    let wrong = sights.len().div_ceil(3);
    assert!(solution.outliers >= wrong * 9 / 10, "{}", solution.outliers);
}

#[test]
fn picks_of_many_things_are_refused() {
    let mut sights = fly(weaving, 7, 1.0);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for (k, sight) in sights.iter_mut().enumerate() {
        if k % 4 > 0 {
            sight.pixel.u = rng.random_range(0.0..1280.0);
            sight.pixel.v = rng.random_range(0.0..720.0);
        }
    }
    let refused = solve(&start(true), &sights).unwrap_err();
    assert!(
        matches!(refused, SolveError::NoAgreement { .. }),
        "{refused}"
    );
    let few = solve(&start(true), &sights[..5]).unwrap_err();
    assert!(matches!(few, SolveError::TooFew { sights: 5, .. }));
}

#[test]
fn turns_to_one_side_hide_the_clock_and_the_words_ask_for_the_other() {
    let mut begin = start(true);
    begin.sigmas[Parameter::Heading as usize] = 0.03;
    let one_sided = solve(&begin, &fly(to_the_right, 1, 3.0)).unwrap();
    let words = observability(&one_sided).join("\n");
    assert!(words.contains("fly a left turn too"), "{words}");
    let both = solve(&start(true), &fly(weaving, 1, 1.0)).unwrap();
    let words = observability(&both).join("\n");
    assert!(!words.contains("clock"), "{words}");
}

#[test]
fn a_hover_shows_no_clock_and_the_words_say_what_would() {
    let solution = solve(&start(true), &fly(hover, 1, 1.0)).unwrap();
    let words = observability(&solution).join("\n");
    assert!(words.contains("gusts or turns are needed"), "{words}");
    assert!(solution.sigma(Parameter::Clock as usize) > 0.1);
}

#[test]
fn heading_and_mount_yaw_are_said_to_be_one_where_they_are() {
    let mut begin = start(true);
    begin.sigmas[Parameter::Heading as usize] = 0.05;
    let solution = solve(&begin, &fly(level, 1, 1.0)).unwrap();
    let yaw = solution.sigma(Parameter::MountYaw as usize);
    assert!(yaw > 3.0 * solution.bearing_sigma(), "{yaw}");
    let words = observability(&solution).join("\n");
    assert!(
        words.contains("can't be told from the autopilot's heading"),
        "{words}"
    );
}

#[test]
fn any_fixed_point_shows_the_mount_and_says_what_the_survey_would_add() {
    let solution = solve(&start(false), &fly(weaving, 4, 1.0)).unwrap();
    assert!(boresight_error_deg(&solution) < 0.3);
    assert!((solution.clock_s() - 0.3).abs() < 0.03);
    assert!(observability(&solution).join("\n").contains("--marker"));
}

#[test]
fn neighbours_that_resemble_each_other_widen_the_sigmas() {
    let mut wandering = fly(weaving, 5, 1.0);
    let white = solve(&start(true), &wandering).unwrap();
    for (k, sight) in wandering.iter_mut().enumerate() {
        sight.pixel.u += 4.0 * (k as f64 / 3.0).sin();
    }
    let solution = solve(&start(true), &wandering).unwrap();
    assert!(solution.widened > 2.0, "{}", solution.widened);
    let (wide, narrow) = (solution.boresight_sigma(), white.boresight_sigma());
    assert!(wide > 1.5 * narrow, "{wide} {narrow}");
}

/// Tilts what is believed of the airframe by Gauss-Markov processes about east and north.
fn wandering_tilt(rng: &mut ChaCha8Rng, tilt: Wandering, sights: &mut [Sight]) {
    let mut now = [tilt.sigma * noise(rng), tilt.sigma * noise(rng)];
    let mut before = sights[0].at;
    for sight in sights {
        let keep = (-(sight.at - before).as_secs_f64() / tilt.correlation_s).exp();
        let renew = tilt.sigma * (1.0 - keep * keep).sqrt();
        now = now.map(|value| keep * value + renew * noise(rng));
        before = sight.at;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(now[0], now[1], 0.0));
        for body in &mut sight.way.bodies {
            body.enu_from_body = turn * body.enu_from_body;
        }
    }
}

#[test]
fn a_tilt_that_wanders_is_not_pressed_into_the_mount() {
    let tilt = Wandering {
        sigma: 0.3_f64.to_radians(),
        correlation_s: 15.0,
    };
    let mut as_process = start(true);
    as_process.sigmas[Parameter::Tilt as usize] = tilt.sigma;
    as_process.sigmas[Parameter::Tilt as usize + 1] = tilt.sigma;
    let as_constant = as_process.clone();
    as_process.wandering = [STILL, tilt, tilt, STILL, STILL, STILL];
    let (mut process, mut constant, mut within, mut all) = (0.0, 0.0, 0, 0);
    for seed in 0..20 {
        let mut sights = fly(weaving, 200 + seed, 1.0);
        wandering_tilt(&mut ChaCha8Rng::seed_from_u64(seed), tilt, &mut sights);
        let solution = solve(&as_process, &sights).unwrap();
        process += boresight_error_deg(&solution).powi(2);
        constant += boresight_error_deg(&solve(&as_constant, &sights).unwrap()).powi(2);
        for axis in 0..3 {
            let error = (solution.parameters[axis] - truth()[axis]).abs();
            within += usize::from(error < 2.0 * solution.sigma(axis));
            all += 1;
        }
    }
    assert!(
        process < 0.5 * constant,
        "mean squares {process} and {constant}"
    );
    // 95 % of 60 is 57; four fewer than that happens once in a hundred.
    assert!(within >= 53, "{within} of {all} within two sigma");
}

#[test]
fn mount_angles_come_back_from_their_rotation() {
    let mount = MountAngles {
        yaw_rad: 0.4,
        depression_rad: 0.7,
        roll_rad: -0.2,
    };
    let turn: Matrix3<f64> = rotation_matrix(&body_from_camera::<CamLeftRaw>(mount));
    let back = mount_of(&turn);
    for (a, b) in [
        (mount.yaw_rad, back.yaw_rad),
        (mount.depression_rad, back.depression_rad),
        (mount.roll_rad, back.roll_rad),
    ] {
        assert!((a - b).abs() < 1e-12);
    }
    assert_eq!(N, Parameter::Marker as usize + 3);
}
