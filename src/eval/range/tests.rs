//! The truth against the pictures, and the strongest claims on a few flames.

use super::outcome::{BEST, Bench, Verdict};
use super::papers::FullFrame;
use super::stage::{Recipe, RigName, SeedSet, Stage, Trial};
use super::*;
use emberfix_calib::{Eye, RawPixel, RectifiedPixel};
use opencv::core::{Mat, MatTraitConst, Vec3b};

const OPTIONS: Options = Options {
    seed: 3,
    repeats: 4,
    quick: true,
    set: SeedSet::Report,
    only: None,
    rounds: false,
};

fn stage(name: RigName) -> Stage {
    Stage::new(name, &stage::world().unwrap()).unwrap()
}

/// A still flame in a dark room.
fn dark(depth_m: f64) -> Recipe {
    Recipe {
        depth_m: depth_m..depth_m,
        width_m: 0.8..1.2,
        u_px: 500.0..800.0,
        v_px: 300.0..420.0,
        daylight: 0.0..0.0,
        exposure: 0.3..0.3,
        wind_m_s: 0.0..0.0,
        indoors: true,
        hardness: None,
    }
}

/// Rectified middle of all that shines, weighed by light.
fn middle(image: &Mat, rig: &emberfix_calib::Rig, eye: Eye) -> RectifiedPixel {
    let (mut columns, mut rows, mut light) = (0.0, 0.0, 0.0);
    for row in 0..image.rows() {
        for column in 0..image.cols() {
            let grey = if eye == Eye::Left {
                let [_, green, red] = image.at_2d::<Vec3b>(row, column).unwrap().0;
                0.5 * (f64::from(green) + f64::from(red))
            } else {
                f64::from(*image.at_2d::<u8>(row, column).unwrap())
            };
            // Gamma undone: linear light has the centroid that geometry gives it.
            let linear = if grey > 70.0 {
                (grey / 255.0).powf(2.2)
            } else {
                0.0
            };
            columns += linear * f64::from(column);
            rows += linear * f64::from(row);
            light += linear;
        }
    }
    let raw = RawPixel {
        u: columns / light,
        v: rows / light,
    };
    rig.rectification().rectify(eye, &[raw]).unwrap()[0]
}

#[test]
fn the_truth_is_where_both_pictures_show_the_flame() {
    let stage = stage(RigName::Ours120);
    let mut off = Vec::new();
    for seed in 0..6 {
        let trial = stage
            .trial(&dark(12.0), SeedSet::Tuning, seed)
            .unwrap()
            .unwrap();
        let right = trial.pair.right_gray.as_ref().unwrap();
        let left = middle(&trial.pair.left_bgr, &stage.rig, Eye::Left);
        let disparity = left.u - middle(right, &stage.rig, Eye::Right).u;
        off.push(disparity - trial.truth.disparity_px(left.v));
    }
    // Eyes weigh colours differently, and light lies a little before the axis: a tenth of a pixel of about
    // eight.
    let bias = mean(&off).unwrap();
    println!("the pictures less the truth: {bias:.3} px, {off:.3?}");
    assert!(bias.abs() < 0.1, "{bias} px: {off:?}");
}

fn bytes(trial: &Trial) -> Vec<u8> {
    use opencv::prelude::MatTraitConstManual;
    trial.pair.left_bgr.data_bytes().unwrap().to_vec()
}

#[test]
fn a_seed_gives_the_same_flame_and_the_sets_differ() {
    let stage = stage(RigName::P4);
    let recipe = tables::P4_INFRARED.recipe(2.0);
    let trial = |set, seed| bytes(&stage.trial(&recipe, set, seed).unwrap().unwrap());
    let first = trial(SeedSet::Tuning, 1);
    assert_eq!(first, trial(SeedSet::Tuning, 1));
    assert_ne!(first, trial(SeedSet::Tuning, 2));
    assert_ne!(first, trial(SeedSet::Report, 1));
}

#[test]
fn a_part_of_the_frame_is_matched_as_the_whole_is() {
    let stage = stage(RigName::Ours120);
    let mut recipe = dark(12.0);
    recipe.daylight = 0.5..0.5;
    let trial = stage.trial(&recipe, SeedSet::Tuning, 4).unwrap().unwrap();
    let mut papers = FullFrame::new(&stage.rig, stage.num_disparities).unwrap();
    let read = papers.read(&trial.pair, &trial.target.box_px).unwrap();
    let whole = papers.match_frames(&trial.pair).unwrap().unwrap();
    let in_whole = papers
        .median_in(&whole, &trial.pair, &trial.target.box_px)
        .unwrap();
    let difference = read.median_px.unwrap() - in_whole.unwrap();
    assert!(difference.abs() <= 1.0 / 16.0, "{difference} px");
}

#[test]
fn the_default_halves_the_papers_errors_and_calls_no_phantom() {
    let world = stage::world().unwrap();
    let lab = Stage::new(RigName::P1, &world).unwrap();
    let bench = Bench::new(&lab);
    for (distance_m, printed_percent) in [(2.0, 2.20), (5.0, 4.18)] {
        let recipe = tables::P1.recipe(distance_m);
        let rounds = tables::rounds(&bench, &recipe, &OPTIONS, 1, 6).unwrap();
        let errors: Vec<f64> = rounds
            .iter()
            .filter_map(|round| Some(round.truth.depth_m(round.said[BEST].measured_px()?)))
            .map(|found_m| 100.0 * (found_m / distance_m - 1.0).abs())
            .collect();
        assert!(errors.len() >= 5, "{} of 6 at {distance_m} m", errors.len());
        // Six flames scatter: the bound is half, the test asks for less than the whole.
        let error = mean(&errors).unwrap();
        assert!(error < 0.8 * printed_percent, "{error} % at {distance_m} m");
    }
    let rig = Stage::new(RigName::Ours75, &world).unwrap();
    let bench = Bench::new(&rig);
    let recipe = Hardness::SaturatedCore.recipe();
    let rounds = tables::rounds(&bench, &recipe, &OPTIONS, 2, 12).unwrap();
    let phantoms = rounds
        .iter()
        .filter(|round| round.said[BEST].verdict == Verdict::PhantomNear)
        .count();
    assert_eq!((rounds.len(), phantoms), (12, 0));
}

#[test]
fn the_default_owns_up_to_branches_and_to_flicker() {
    let rig = Stage::new(RigName::Ours120, &stage::world().unwrap()).unwrap();
    let bench = Bench::new(&rig);
    for (k, case) in [Hardness::Branches, Hardness::Flicker]
        .into_iter()
        .enumerate()
    {
        let rounds = tables::rounds(&bench, &case.recipe(), &OPTIONS, 4 + k as u64, 24).unwrap();
        let off = rounds
            .iter()
            .filter_map(|round| round.said[BEST].off_sigmas());
        let off: Vec<f64> = off.collect();
        let normalised = rms(&off).unwrap();
        println!("{}: {normalised:.2} of {}", case.name(), off.len());
        // It refuses few, and 24 flames scatter by 0.15 about what hundreds come to; without leaving branches
        // out it was 2.5.
        assert!(off.len() >= 18, "{} of 24", off.len());
        assert!(
            (0.5..1.6).contains(&normalised),
            "{}: {normalised}",
            case.name()
        );
    }
}

fn suite(case: Hardness, off_sigmas: f64, count: usize) -> Suite {
    let rig = stage(RigName::Ours75);
    let trial = rig.trial(&dark(12.0), SeedSet::Tuning, 0).unwrap().unwrap();
    let truth = trial.truth;
    let said = outcome::Said {
        disparity: Some((5.0 + 0.1 * off_sigmas, 0.1)),
        measured: true,
        truth_px: 5.0,
        verdict: Verdict::Right,
    };
    let round = Round {
        truth,
        said: [said; NAMES.len()],
    };
    Suite {
        case,
        rounds: vec![round; count],
    }
}

#[test]
fn the_least_honest_case_is_the_farthest_from_one_either_way_and_has_enough_answers() {
    let suites = [
        suite(Hardness::Glints, 1.3, FEWEST),
        suite(Hardness::Flicker, 0.5, FEWEST),
        suite(Hardness::Branches, 5.0, FEWEST - 1),
    ];
    let (value, n) = hardness::least_honest(&suites, 0..OURS, FEWEST);
    assert!((value.unwrap() - 0.5).abs() < 1e-9, "{value:?}");
    assert_eq!(n, FEWEST);
    assert_eq!(
        hardness::least_honest(&suites[2..], 0..OURS, FEWEST),
        (None, 0)
    );
}
