//! What makes flames hard to range, each as a change of an ordinary trial.

use super::stage::{Recipe, SetUp, Stage, within};
use emberfix_calib::Eye;
use emberfix_sim::render::studio::{Branch, Puff, PuffKind, Smudge, StudioFire};
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// One kind of hardness.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Hardness {
    /// Cores without texture at night, a glow and ghosts in each lens, lamps as bright beside it.
    SaturatedCore,
    /// The eyes expose 8 to 25 ms apart.
    Flicker,
    /// Smoke before the right eye alone.
    SmokeInOneEye,
    /// Facets that mirror into one eye, and nearer ones that both eyes see.
    Glints,
    /// Its like burns beside it on the same row.
    TwoFlames,
    /// Branches between rig and flame.
    Branches,
    /// Part of it lies outside of an eye's image.
    Border,
    /// Wide and near, blown about, 30 to 50 ms apart.
    ShapeDiffers,
    /// A blurred right eye with a smudge on the flame.
    DirtyEye,
    /// No right eye, a black one, or noise.
    DeadEye,
}

impl Hardness {
    pub(super) const ALL: [Self; 10] = [
        Self::SaturatedCore,
        Self::Flicker,
        Self::SmokeInOneEye,
        Self::Glints,
        Self::TwoFlames,
        Self::Branches,
        Self::Border,
        Self::ShapeDiffers,
        Self::DirtyEye,
        Self::DeadEye,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::SaturatedCore => "saturated_core",
            Self::Flicker => "flicker",
            Self::SmokeInOneEye => "smoke_in_one_eye",
            Self::Glints => "glints",
            Self::TwoFlames => "two_flames",
            Self::Branches => "branches",
            Self::Border => "border",
            Self::ShapeDiffers => "shape_differs",
            Self::DirtyEye => "dirty_eye",
            Self::DeadEye => "dead_eye",
        }
    }

    pub(super) fn recipe(self) -> Recipe {
        let usual = Recipe {
            depth_m: 5.0..25.0,
            width_m: 0.5..1.4,
            u_px: 300.0..1000.0,
            v_px: 200.0..520.0,
            daylight: 0.1..1.2,
            exposure: 0.8..1.6,
            wind_m_s: 0.0..2.0,
            indoors: false,
            hardness: Some(self),
        };
        match self {
            Self::SaturatedCore => Recipe {
                exposure: 5.0..40.0,
                daylight: 0.0..0.03,
                ..usual
            },
            // The flame's left part is cut off in the right eye or in both.
            Self::Border => Recipe {
                u_px: -5.0..45.0,
                depth_m: 5.0..12.0,
                ..usual
            },
            Self::ShapeDiffers => Recipe {
                depth_m: 2.5..6.0,
                wind_m_s: 3.0..6.0,
                ..usual
            },
            _ => usual,
        }
    }

    pub(super) fn apply(self, stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
        match self {
            Self::SaturatedCore => lamps(stage, set_up, rng),
            Self::Flicker => skew(set_up, rng.random_range(0.008..0.025)),
            Self::ShapeDiffers => skew(set_up, rng.random_range(0.030..0.050)),
            Self::SmokeInOneEye => smoke(stage, set_up, rng),
            Self::Glints => glints(stage, set_up, rng),
            Self::TwoFlames => twin(stage, set_up, rng),
            Self::Branches => branches(stage, set_up, rng),
            Self::Border => {}
            Self::DirtyEye => dirt(stage, set_up, rng),
            Self::DeadEye => dead(set_up, rng),
        }
    }
}

fn skew(set_up: &mut SetUp, seconds: f64) {
    if let Some(right) = &mut set_up.right {
        right.skew_s = seconds;
    }
}

/// Middle of the flame, and a step to its right and up, east, north, up.
fn frame_of(stage: &Stage, set_up: &SetUp) -> (Vector3<f64>, Vector3<f64>, Vector3<f64>) {
    let fire = set_up.target();
    let middle = fire.base_m + Vector3::z() * (0.5 * fire.height_m);
    (middle, stage.enu(Vector3::x()), Vector3::z())
}

fn lamps(stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    set_up.left.glare = rng.random_range(0.01..0.05);
    if let Some(right) = &mut set_up.right {
        right.glare = set_up.left.glare;
    }
    let (middle, right, up) = frame_of(stage, set_up);
    let fire = set_up.target();
    for _ in 0..rng.random_range(1..5) {
        let aside = fire.width_m * rng.random_range(0.8..2.5) * side(rng);
        let high = fire.height_m * rng.random_range(-0.3..0.3);
        let nearer = rng.random_range(0.9..1.3);
        set_up.add_puff(Puff {
            centre_m: (middle + right * aside + up * high) * nearer,
            radius_m: fire.width_m * rng.random_range(0.2..0.6),
            kind: PuffKind::Light { strength: 4.0 },
            only: None,
        });
    }
    // What a lens mirrors within itself stands elsewhere in each eye.
    for only in [Eye::Left, Eye::Right, Eye::Right] {
        let aside = fire.width_m * rng.random_range(-1.2..1.2);
        let high = fire.height_m * rng.random_range(-0.6..0.6);
        set_up.add_puff(Puff {
            centre_m: middle + right * aside + up * high,
            radius_m: fire.width_m * rng.random_range(0.1..0.4),
            kind: PuffKind::Light {
                strength: rng.random_range(0.01..0.2),
            },
            only: Some(only),
        });
    }
}

fn side(rng: &mut ChaCha8Rng) -> f64 {
    if rng.random() { 1.0 } else { -1.0 }
}

fn smoke(stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    let (middle, right, up) = frame_of(stage, set_up);
    let fire = set_up.target();
    let opacity = rng.random_range(0.3..0.9);
    for _ in 0..12 {
        let aside = fire.width_m * rng.random_range(-0.7..0.7);
        let high = fire.height_m * rng.random_range(-0.5..0.5);
        set_up.add_puff(Puff {
            centre_m: (middle + right * aside + up * high) * 0.5,
            radius_m: 0.5 * fire.width_m * rng.random_range(0.25..0.7),
            kind: PuffKind::Smoke {
                opacity: opacity * rng.random_range(0.3..1.0),
            },
            only: Some(Eye::Right),
        });
    }
}

fn glints(stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    let (middle, right, up) = frame_of(stage, set_up);
    let fire = set_up.target();
    for k in 0..rng.random_range(8..24) {
        let aside = fire.width_m * rng.random_range(-0.6..0.6);
        let high = fire.height_m * rng.random_range(-0.6..0.1);
        // One in four is a thing of its own nearer to the rig, the others live in one eye.
        let (only, scale) = match k % 4 {
            0 => (None, rng.random_range(0.5..0.9)),
            1 | 2 => (Some(Eye::Right), 0.98),
            _ => (Some(Eye::Left), 0.98),
        };
        set_up.add_puff(Puff {
            centre_m: (middle + right * aside + up * high) * scale,
            radius_m: scale * fire.width_m * rng.random_range(0.02..0.08),
            kind: PuffKind::Light {
                strength: rng.random_range(0.5..3.0),
            },
            only,
        });
    }
}

fn twin(stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    let (_, right, _) = frame_of(stage, set_up);
    let fire = set_up.target();
    let aside = fire.width_m * rng.random_range(1.1..2.5) * side(rng);
    let deeper = rng.random_range(0.92..1.15);
    set_up.shot.fires.push(StudioFire {
        base_m: (fire.base_m + right * aside) * deeper,
        // Half of them burn from the same burner's mould, a moment apart.
        seed: if rng.random() {
            fire.seed
        } else {
            rng.random()
        },
        height_m: fire.height_m * within(rng, &(0.9..1.1)),
        ..fire
    });
}

fn branches(stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    let (middle, right, up) = frame_of(stage, set_up);
    let fire = set_up.target();
    for _ in 0..rng.random_range(3..8) {
        let scale = rng.random_range(0.4..0.9);
        let mut end = |reach: f64| {
            let aside = fire.width_m * (reach + rng.random_range(-0.4..0.4));
            let high = fire.height_m * rng.random_range(-0.7..0.7);
            (middle + right * aside + up * high) * scale
        };
        let (from_m, to_m) = (end(-0.6), end(0.6));
        set_up.add_branch(Branch {
            from_m,
            to_m,
            radius_m: scale * fire.width_m * rng.random_range(0.015..0.05),
        });
    }
}

fn dirt(stage: &Stage, set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    let (middle, ..) = frame_of(stage, set_up);
    let depth_m = set_up.depth_m;
    let Some(look) = &mut set_up.right else {
        return;
    };
    let shift_px = stage.rig.disparity_px(depth_m);
    let (u, v) = stage.left_pixel(middle);
    let reach = rng.random_range(12.0..50.0);
    look.blur_px = rng.random_range(1.5..4.0);
    look.dirt.push(Smudge {
        at_px: (
            u - shift_px + rng.random_range(-20.0..20.0),
            v + rng.random_range(-20.0..20.0),
        ),
        radius_px: reach,
        opacity: rng.random_range(0.4..0.97),
    });
}

fn dead(set_up: &mut SetUp, rng: &mut ChaCha8Rng) {
    match rng.random_range(0..3) {
        0 => set_up.right = None,
        kind => {
            if let Some(look) = &mut set_up.right {
                look.gain = 0.0;
                look.noise_sigma_dn = if kind == 1 { 0.0 } else { 6.0 };
            }
        }
    }
}
