//! One simulated rig: made up, photographed, calibrated, compared.

use super::CalibrationEvalError;
use super::boards::{Held, NEAR_INFRARED, Paper, Rays, Sight, VISIBLE, render};
use emberfix_calib::solve::{
    Board, Calibration, Demands, View, calibrate as solve, find_corners, make_consistent,
};
use emberfix_calib::{Camera, Eye, Mounting, RawPixel, Rig, RigParts};
use emberfix_frames::{Matrix3, Metres, MountAngles, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// P2's and P4's board.
const BOARD: Board = Board::chess(9, 6, 0.028);

/// How the pairs of a rig are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Taken {
    /// By eyes that are triggered together, of a board held as still as `calibrate stereo --live` asks.
    InStep,
    /// A folder of snapshots: eyes not quite in step, and a hand that moves, in a quarter of the pairs by
    /// much.
    Snapshots,
}

impl Taken {
    pub(super) const BOTH: [Self; 2] = [Self::InStep, Self::Snapshots];

    pub(super) fn word(self) -> &'static str {
        match self {
            Self::InStep => "in_step",
            Self::Snapshots => "snapshots",
        }
    }
}

/// What came of one rig.
#[derive(Debug)]
pub(super) struct Outcome {
    number: usize,
    pub taken: Taken,
    pub infrared: bool,
    pairs: usize,
    rms_px: f64,
    widened_by: f64,
    /// Found minus true over sigma: fx, fy of both eyes.
    focal: [f64; 4],
    baseline_mm: f64,
    baseline: f64,
    rotation_y_deg: f64,
    rotation: [f64; 3],
    /// Found range over true range at 10 m, less one.
    pub range_bias: f64,
    /// Its sigma as predicted.
    pub range_sigma: f64,
}

impl Outcome {
    pub(super) fn pulls(&self) -> Vec<f64> {
        let mut all = self.focal.to_vec();
        all.push(self.baseline);
        all.extend(self.rotation);
        all
    }

    pub(super) fn row(&self) -> Vec<String> {
        let eyes = if self.infrared {
            "near-infrared"
        } else {
            "visible"
        };
        vec![
            format!("{} {eyes}", self.number),
            self.taken.word().to_owned(),
            self.pairs.to_string(),
            format!("{:.3}", self.rms_px),
            self.focal.map(|pull| format!("{pull:+.1}")).join(" "),
            format!("{:.2}", self.baseline_mm),
            format!("{:+.1}", self.baseline),
            format!("{:.3}", self.rotation_y_deg),
            self.rotation.map(|pull| format!("{pull:+.1}")).join(" "),
            format!("{:+.3}", 100.0 * self.range_bias),
            format!("{:.3}", 100.0 * self.range_sigma),
        ]
    }

    pub(super) fn details(&self) -> serde_json::Value {
        serde_json::json!({
            "rig": self.number, "near_infrared": self.infrared, "taken": self.taken.word(),
            "pairs": self.pairs,
            "rms_px": self.rms_px, "widened_by": self.widened_by, "pulls": self.pulls(),
            "range_bias_10m": self.range_bias, "range_sigma_10m": self.range_sigma,
        })
    }
}

/// Makes up rig `number` of a seed, takes its pairs, calibrates it and compares.
pub(super) fn calibrate(
    seed: u64,
    number: usize,
    taken: Taken,
    pairs: usize,
) -> Result<Outcome, CalibrationEvalError> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(number as u64);
    let infrared = number % 2 == 1;
    let truth = make_up(&mut random, infrared);
    let rig = truth.check(Path::new("simulated rig"))?;
    let views = photograph(&rig, infrared, taken, pairs, &mut random)?;
    let size = truth.left.image_size_px;
    let calibration = solve(&BOARD, views, size, Demands::default())?;
    let made = (number, infrared, taken);
    compare(made, &truth, &rig, &calibration)
}

/// P3's class of rig, or P4's with its near-infrared left eye (Table I, straightened).
fn make_up(random: &mut impl Rng, infrared: bool) -> RigParts {
    let mut about = |middle: f64, by: f64| middle + random.random_range(-by..by);
    let (size, focal, baseline_m) = if infrared {
        ((640, 480), (512.73, 518.19), 0.12454)
    } else {
        ((1280, 720), (882.5, 881.3), 0.075)
    };
    let (cx, cy) = (f64::from(size.0) / 2.0, f64::from(size.1) / 2.0);
    let mut eye = |focal: f64| {
        let fx = about(focal, 8.0);
        Camera {
            image_size_px: size,
            focal_px: (fx, fx + about(0.0, 1.0)),
            principal_point_px: (about(cx, 8.0), about(cy, 8.0)),
            distortion: [
                about(-0.1, 0.05),
                about(0.06, 0.03),
                about(0.0, 5e-4),
                about(0.0, 5e-4),
                about(0.0, 0.01),
            ],
        }
    };
    let (left, right) = (eye(focal.0), eye(focal.1));
    let turn_deg = Vector3::new(about(0.0, 0.5), about(0.0, 0.5), about(0.0, 0.5));
    let turn = UnitQuaternion::from_scaled_axis(turn_deg.map(f64::to_radians));
    RigParts {
        name: "simulated".to_owned(),
        left,
        right,
        right_from_left: turn.to_rotation_matrix().into_inner(),
        translation_m: Vector3::new(
            -about(baseline_m, 0.003),
            about(0.0, 5e-4),
            about(0.0, 5e-4),
        ),
        max_skew_s: 0.001,
        disparity_bias_px: 0.1,
        mounting: Mounting {
            angles: MountAngles::default(),
            lever_arm_m: Vector3::zeros(),
            time_offset_s: 0.0,
            boresight_sigma_rad: 0.0,
            lever_arm_sigma_m: 0.0,
            time_offset_sigma_s: 0.0,
            right_near_infrared: false,
        },
        calibrated: None,
    }
}

fn photograph(
    rig: &Rig,
    infrared: bool,
    taken: Taken,
    pairs: usize,
    random: &mut ChaCha8Rng,
) -> Result<Vec<View>, CalibrationEvalError> {
    let left_rays = Rays::of(rig.camera(Eye::Left));
    let right_rays = Rays::of(rig.camera(Eye::Right));
    let left_sight: Sight = if infrared { NEAR_INFRARED } else { VISIBLE };
    let paper = paper(random);
    let mut views = Vec::new();
    for number in 0..pairs {
        let (turn, origin_m) = pose(rig, number, random);
        let held = Held {
            board: &BOARD,
            paper,
            turn,
            origin_m,
        };
        let (stepped, blur_px) = step(&held, taken, random);
        let in_right = Held {
            turn: rig.right_from_left() * stepped.turn,
            origin_m: rig.right_from_left() * stepped.origin_m
                + rig.right_from_left_translation_m(),
            ..stepped
        };
        let blurred = |sight: Sight| Sight {
            blur_px: sight.blur_px.hypot(blur_px),
            ..sight
        };
        let left = render(&left_rays, &held, blurred(left_sight), random)?;
        let right = render(&right_rays, &in_right, blurred(VISIBLE), random)?;
        let found = (find_corners(&left, &BOARD)?, find_corners(&right, &BOARD)?);
        if let (Some(left), Some(right)) = found {
            let name = number.to_string();
            views.push(make_consistent(&BOARD, View { name, left, right }));
        }
    }
    Ok(views)
}

/// A print on paper that was glued to a plate: sags of up to a millimetre, waves of a tenth.
fn paper(random: &mut impl Rng) -> Paper {
    Paper {
        bend_per_m: std::array::from_fn(|_| random.random_range(-0.15..0.15)),
        waves_m: random.random_range(0.0..1.5e-4),
    }
}

/// Share of the snapshots in which the hand did not hold still.
const UNSTEADY: f64 = 0.25;

/// The board as the other eye finds it, and the blur of its motion.
fn step<'a>(held: &Held<'a>, taken: Taken, random: &mut impl Rng) -> (Held<'a>, f64) {
    // What `--live` calls still is half a pixel from one look to the next: some millimetres and hundredths
    // of a radian a second, over the millisecond that a rig's `max_skew_s` grants eyes with one trigger.
    const STILL: (f64, f64, f64) = (5e-5, 1e-5, 0.0);
    let (turn_rad, move_m, blur_px) = match taken {
        Taken::InStep => STILL,
        Taken::Snapshots if random.random_bool(UNSTEADY) => {
            (4e-3, 6e-4, random.random_range(0.3..1.0))
        }
        Taken::Snapshots => (5e-4, 1e-4, 0.0),
    };
    let mut vector = |size: f64| Vector3::from_fn(|_, _| random.random_range(-size..size));
    let turn = UnitQuaternion::from_scaled_axis(vector(turn_rad)).to_rotation_matrix();
    let middle = held.turn * BOARD.middle_m();
    let stepped = Held {
        turn: turn.into_inner() * held.turn,
        origin_m: held.origin_m + middle - turn * middle + vector(move_m),
        ..*held
    };
    (stepped, blur_px)
}

/// Places in the image that are visited in turn: corners and edges as often as the middle.
const PLACES: [(f64, f64); 9] = [
    (0.5, 0.5),
    (0.2, 0.25),
    (0.8, 0.75),
    (0.8, 0.25),
    (0.2, 0.75),
    (0.5, 0.25),
    (0.5, 0.75),
    (0.2, 0.5),
    (0.8, 0.5),
];

/// A board that both eyes see whole, near the wanted place, tilted by up to 45 degrees.
fn pose(rig: &Rig, number: usize, random: &mut impl Rng) -> (Matrix3<f64>, Vector3<f64>) {
    let camera = rig.camera(Eye::Left);
    let (width, height) = camera.image_size_px;
    let place = PLACES[number % PLACES.len()];
    let wide_m = BOARD.square_m * (BOARD.columns + 1) as f64;
    let middle = Vector3::new(BOARD.columns as f64 - 1.0, BOARD.rows as f64 - 1.0, 0.0)
        * (0.5 * BOARD.square_m);
    let mut best = (Matrix3::identity(), Vector3::new(0.0, 0.0, 2.0) - middle);
    for attempt in 0..400 {
        // The longer it takes, the more it looks to the middle.
        let pull = f64::from(attempt) / 400.0;
        let toward = |share: f64| share + pull * (0.5 - share);
        let share = random.random_range(0.3..0.75);
        let depth = camera.focal_px.0 * wide_m / (share * f64::from(width));
        let target = Vector3::new(
            (toward(place.0) * f64::from(width) - camera.principal_point_px.0) / camera.focal_px.0,
            (toward(place.1) * f64::from(height) - camera.principal_point_px.1) / camera.focal_px.1,
            1.0,
        ) * depth;
        let axis_rad = random.random_range(0.0..std::f64::consts::TAU);
        let tilt_rad = random.random_range(5.0_f64..45.0).to_radians();
        let tilt = Vector3::new(axis_rad.cos(), axis_rad.sin(), 0.0) * tilt_rad;
        let spin = Vector3::new(0.0, 0.0, random.random_range(-0.3..0.3));
        let turn = (UnitQuaternion::from_scaled_axis(tilt)
            * UnitQuaternion::from_scaled_axis(spin))
        .to_rotation_matrix()
        .into_inner();
        best = (turn, target - turn * middle);
        if seen_whole(rig, &best) {
            return best;
        }
    }
    best
}

fn seen_whole(rig: &Rig, (turn, origin_m): &(Matrix3<f64>, Vector3<f64>)) -> bool {
    let (width, height) = rig.camera(Eye::Left).image_size_px;
    let inside = |pixel: RawPixel| {
        (4.0..f64::from(width) - 4.0).contains(&pixel.u)
            && (4.0..f64::from(height) - 4.0).contains(&pixel.v)
    };
    let (columns, rows) = (BOARD.columns as f64, BOARD.rows as f64);
    [
        (-1.2, -1.2),
        (columns + 0.2, -1.2),
        (-1.2, rows + 0.2),
        (columns + 0.2, rows + 0.2),
    ]
    .into_iter()
    .all(|(a, b)| {
        let point = turn * (Vector3::new(a, b, 0.0) * BOARD.square_m) + origin_m;
        let other = rig.right_from_left() * point + rig.right_from_left_translation_m();
        inside(rig.camera(Eye::Left).project(&point))
            && inside(rig.camera(Eye::Right).project(&other))
    })
}

fn compare(
    (number, infrared, taken): (usize, bool, Taken),
    truth: &RigParts,
    rig: &Rig,
    calibration: &Calibration,
) -> Result<Outcome, CalibrationEvalError> {
    let solution = &calibration.solution;
    let sigmas = solution.sigmas();
    let pull = |found: f64, true_value: f64, index: usize| (found - true_value) / sigmas[index];
    let off = UnitQuaternion::from_matrix(
        &(solution.right_from_left * truth.right_from_left.transpose()),
    )
    .scaled_axis();
    let found = RigParts {
        left: solution.left.clone(),
        right: solution.right.clone(),
        right_from_left: solution.right_from_left,
        translation_m: solution.translation_m,
        ..truth.clone()
    };
    let found = found.check(Path::new("calibrated rig"))?;
    let at_10m = calibration
        .range_errors
        .iter()
        .find(|error| error.depth_m == 10.0);
    Ok(Outcome {
        number,
        infrared,
        taken,
        pairs: calibration.views.len(),
        rms_px: solution.rms_px(),
        widened_by: solution.widened_by,
        focal: [
            pull(solution.left.focal_px.0, truth.left.focal_px.0, 0),
            pull(solution.left.focal_px.1, truth.left.focal_px.1, 1),
            pull(solution.right.focal_px.0, truth.right.focal_px.0, 9),
            pull(solution.right.focal_px.1, truth.right.focal_px.1, 10),
        ],
        baseline_mm: 1e3 * solution.baseline_m(),
        baseline: (solution.baseline_m() - truth.translation_m.norm())
            / solution.baseline_sigma_m(),
        rotation_y_deg: off.y.to_degrees(),
        rotation: [off.x / sigmas[18], off.y / sigmas[19], off.z / sigmas[20]],
        range_bias: range_bias(rig, &found, 10.0)?,
        range_sigma: at_10m.map_or(f64::NAN, emberfix_calib::solve::RangeError::share),
    })
}

/// Mean over the image's middle half of found over true straight-line range, less one.
fn range_bias(truth: &Rig, found: &Rig, depth_m: f64) -> Result<f64, CalibrationEvalError> {
    let camera = truth.camera(Eye::Left);
    let (width, height) = camera.image_size_px;
    let (mut sum, mut count) = (0.0, 0.0);
    for across in [0.25, 0.5, 0.75] {
        for down in [0.25, 0.5, 0.75] {
            let point = Vector3::new(
                (across * f64::from(width) - camera.principal_point_px.0) / camera.focal_px.0,
                (down * f64::from(height) - camera.principal_point_px.1) / camera.focal_px.1,
                1.0,
            ) * depth_m;
            let other = truth.right_from_left() * point + truth.right_from_left_translation_m();
            let rectification = found.rectification();
            let left = rectification.rectify(Eye::Left, &[camera.project(&point)])?[0];
            let seen = truth.camera(Eye::Right).project(&other);
            let right = rectification.rectify(Eye::Right, &[seen])?[0];
            let Some(depth) = found.depth_m(left.u - right.u) else {
                return Ok(f64::NAN);
            };
            sum += found.point(left, depth).metres().norm() / point.norm() - 1.0;
            count += 1.0;
        }
    }
    Ok(sum / count)
}
