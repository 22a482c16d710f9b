//! Opaque things on the ground, and marks on it.

use super::burning::{Splat, SplatKind, unit};
use super::config::BoardConfig;
use nalgebra::{Vector2, Vector3};
use std::f64::consts::TAU;

/// A ball of leaves, or any ball.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ball {
    /// East, north, up.
    pub centre_m: Vector3<f64>,
    pub radius_m: f64,
    /// Linear albedo.
    pub albedo: [f32; 3],
}

/// A flat parallelogram, seen from both sides.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Quad {
    /// One corner: east, north, up.
    pub corner_m: Vector3<f64>,
    /// Along the rows of tiles.
    pub along_m: Vector3<f64>,
    /// Across the rows.
    pub across_m: Vector3<f64>,
    /// Linear albedo.
    pub albedo: [f32; 3],
    /// Rows of tiles or planks across; 0 is plain.
    pub rows: f32,
}

/// A mark on the ground.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mark {
    pub kind: MarkKind,
    /// East, north.
    pub centre_m: Vector2<f64>,
    pub radius_m: f64,
}

/// What a mark does to the ground's colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MarkKind {
    /// Keeps the sun away.
    Shadow,
    /// Burnt black, ragged edge.
    Scorch,
    /// Standing water that mirrors the sky.
    Puddle,
}

/// Wavering sparkles of the sun on water.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Glint {
    pub seed: u64,
    pub centre_m: Vector3<f64>,
    pub radius_m: f64,
}

impl Glint {
    /// Facets of the water that send the sun into an eye at `eye_m` at this time.
    pub(crate) fn splats(&self, eye_m: &Vector3<f64>, sun: &Vector3<f64>, t_s: f64) -> Vec<Splat> {
        (0..40)
            .filter_map(|k| self.sparkle(k, eye_m, sun, t_s))
            .collect()
    }

    fn sparkle(&self, k: u32, eye_m: &Vector3<f64>, sun: &Vector3<f64>, t_s: f64) -> Option<Splat> {
        let radius = 0.85 * self.radius_m * unit(self.seed, k, 1).sqrt();
        let (sin, cos) = (TAU * unit(self.seed, k, 2)).sin_cos();
        let at = self.centre_m + Vector3::new(radius * cos, radius * sin, 0.01);
        let half = (sun + (eye_m - at).normalize()).normalize();
        let miss = (self.ripple(k, t_s) - half.xy() / half.z.max(0.05) * FOCUS).norm();
        let brightness = (-(miss / 0.16).powi(2)).exp();
        let half_width_m = 0.11 * self.radius_m * (0.4 + 0.6 * unit(self.seed, k, 3));
        (brightness > 0.02).then(|| Splat {
            kind: SplatKind::Light,
            centre_m: at,
            half_axis_m: Vector3::new(0.0, 0.0, half_width_m),
            half_width_m,
            colour: [9.0, 7.6, 5.2].map(|c| c * brightness as f32),
            opacity: 0.0,
            billow: (0.0, 0.0),
        })
    }

    /// Slope of a facet.
    fn ripple(&self, k: u32, t_s: f64) -> Vector2<f64> {
        let turn = |axis: u32| {
            let rate = 1.5 + 4.0 * unit(self.seed, k, 10 + axis);
            0.28 * (rate * t_s + TAU * unit(self.seed, k, 20 + axis)).sin()
        };
        Vector2::new(turn(0), turn(1))
    }
}

/// Facets tilt towards the viewer oftener than real water does: a lookalike that is never seen
/// tests nothing.
const FOCUS: f64 = 0.25;

/// What stands in a world and does not move.
#[derive(Debug, Clone, Default)]
pub(crate) struct Things {
    pub balls: Vec<Ball>,
    pub quads: Vec<Quad>,
    pub marks: Vec<Mark>,
    pub glints: Vec<Glint>,
    /// Lamps and fog.
    pub clouds: Vec<Splat>,
}

/// Paint of a car that should not be seen for its colour.
pub(crate) const DARK: [f32; 3] = [0.04, 0.04, 0.05];

/// Paint of a car that looks like fire.
pub(crate) fn signal_orange(seed: u64) -> [f32; 3] {
    [0.80, 0.20 + 0.1 * unit(seed, 0, 32) as f32, 0.025]
}

impl Things {
    /// A crown of leaf balls on a trunk, with its shadow.
    pub(crate) fn add_tree(
        &mut self,
        foot: Vector3<f64>,
        height_m: f64,
        seed: u64,
        sun: &Vector3<f64>,
    ) {
        let bush = height_m < 2.0;
        let crown = (if bush { 0.5 } else { 0.32 }) * height_m;
        let albedo = leaf_albedo(seed);
        let balls = if bush { 4 } else { 9 };
        for k in 0..balls {
            let (sin, cos) = (TAU * unit(seed, k, 1)).sin_cos();
            let out = crown * 0.75 * unit(seed, k, 2).sqrt();
            let up = height_m - crown * (0.55 + 1.1 * unit(seed, k, 3));
            let light = 0.8 + 0.4 * unit(seed, k, 5) as f32;
            self.balls.push(Ball {
                centre_m: foot + Vector3::new(out * cos, out * sin, up.max(0.3 * crown)),
                radius_m: crown * (0.38 + 0.2 * unit(seed, k, 4)),
                albedo: albedo.map(|a| a * light),
            });
        }
        if !bush {
            self.add_trunk(foot, 0.6 * height_m, 0.03 * height_m);
        }
        self.add_shadow(foot, height_m - crown, 1.2 * crown, sun);
    }

    fn add_trunk(&mut self, foot: Vector3<f64>, height_m: f64, radius_m: f64) {
        for side in [Vector3::x(), Vector3::y()] {
            self.quads.push(Quad {
                corner_m: foot - side * radius_m,
                along_m: side * (2.0 * radius_m),
                across_m: Vector3::z() * height_m,
                albedo: [0.11, 0.08, 0.06],
                rows: 0.0,
            });
        }
    }

    fn add_shadow(&mut self, foot: Vector3<f64>, height_m: f64, radius_m: f64, sun: &Vector3<f64>) {
        let throw = -sun.xy() * (height_m / sun.z.max(0.2));
        self.marks.push(Mark {
            kind: MarkKind::Shadow,
            centre_m: foot.xy() + throw,
            radius_m,
        });
    }

    /// A house with a saturated red-orange roof.
    pub(crate) fn add_house(
        &mut self,
        foot: Vector3<f64>,
        size_m: f64,
        seed: u64,
        sun: &Vector3<f64>,
    ) {
        let (along, across) = turned(seed, size_m, 0.7 * size_m);
        let (walls, rise) = (0.35 * size_m, 0.22 * size_m);
        let hue = 0.08 * unit(seed, 0, 31) as f32;
        let roof = [0.62, 0.13 + hue, 0.05];
        self.add_box(foot, along, across, walls, [0.5, 0.46, 0.4]);
        let eaves = foot - (along + across) * 0.54 + Vector3::z() * walls;
        let ridge = across * 0.54 + Vector3::z() * rise;
        let rows = (8.0 * size_m as f32 / 3.0).max(4.0);
        self.quads.push(Quad {
            corner_m: eaves,
            along_m: along * 1.08,
            across_m: ridge,
            albedo: roof,
            rows,
        });
        let far = eaves + across * 1.08;
        let back = ridge - across * 1.08;
        self.quads.push(Quad {
            corner_m: far,
            along_m: along * 1.08,
            across_m: back,
            albedo: roof,
            rows,
        });
        self.add_shadow(foot, walls, 0.7 * size_m, sun);
    }

    /// A car.
    pub(crate) fn add_vehicle(
        &mut self,
        foot: Vector3<f64>,
        size_m: f64,
        seed: u64,
        paint: [f32; 3],
        sun: &Vector3<f64>,
    ) {
        let (along, across) = turned(seed, size_m, 0.42 * size_m);
        let (body, cabin) = (0.19 * size_m, 0.13 * size_m);
        self.add_box(
            foot + Vector3::z() * (0.05 * size_m),
            along,
            across,
            body,
            paint,
        );
        let roof = foot + Vector3::z() * (0.05 * size_m + body);
        self.add_box(
            roof,
            along * 0.5,
            across * 0.85,
            0.8 * cabin,
            [0.03, 0.035, 0.04],
        );
        self.add_box(
            roof + Vector3::z() * (0.8 * cabin),
            along * 0.46,
            across * 0.8,
            0.2 * cabin,
            paint,
        );
        self.add_shadow(foot, 0.5 * body, 0.45 * size_m, sun);
    }

    /// A box about `middle`, standing on it.
    fn add_box(
        &mut self,
        middle: Vector3<f64>,
        along: Vector3<f64>,
        across: Vector3<f64>,
        height_m: f64,
        albedo: [f32; 3],
    ) {
        let corner = middle - (along + across) * 0.5;
        let up = Vector3::z() * height_m;
        let sides = [
            (corner, along, up),
            (corner + across, along, up),
            (corner, across, up),
            (corner + along, across, up),
            (corner + up, along, across),
        ];
        let quads = sides.map(|(corner_m, along_m, across_m)| Quad {
            corner_m,
            along_m,
            across_m,
            albedo,
            rows: 0.0,
        });
        self.quads.extend(quads);
    }

    /// A chessboard on the ground: black squares on a white sheet.
    pub(crate) fn add_board(&mut self, foot: Vector3<f64>, board: &BoardConfig) {
        const WHITE: [f32; 3] = [0.85, 0.85, 0.85];
        const BLACK: [f32; 3] = [0.03, 0.03, 0.03];
        let (sin, cos) = board.turn_deg.to_radians().sin_cos();
        let along = Vector3::new(cos, sin, 0.0) * board.square_m;
        let across = Vector3::new(-sin, cos, 0.0) * board.square_m;
        // Squares are one more than inner corners, the margin is one square more on each side.
        let (columns, rows) = (board.columns + 1, board.rows + 1);
        let printed = foot + Vector3::z() * BoardConfig::THICKNESS_M;
        let corner = printed - (along * f64::from(columns) + across * f64::from(rows)) * 0.5;
        let mut add = |corner_m, along_m, across_m, albedo| {
            self.quads.push(Quad {
                corner_m,
                along_m,
                across_m,
                albedo,
                rows: 0.0,
            });
        };
        add(
            // A hair lower, so that the squares lie on it.
            corner - along - across - Vector3::z() * 0.002,
            along * f64::from(columns + 2),
            across * f64::from(rows + 2),
            WHITE,
        );
        for (column, row) in (0..columns).flat_map(|c| (0..rows).map(move |r| (c, r))) {
            if (column + row) % 2 == 0 {
                let at = corner + along * f64::from(column) + across * f64::from(row);
                add(at, along, across, BLACK);
            }
        }
    }

    /// A steady lamp on a stake.
    pub(crate) fn add_lantern(&mut self, foot: Vector3<f64>, size_m: f64) {
        let lamp = |half: f64, colour: [f32; 3]| Splat {
            kind: SplatKind::Light,
            centre_m: foot + Vector3::z() * (1.5 * size_m),
            half_axis_m: Vector3::z() * half,
            half_width_m: half,
            colour,
            opacity: 0.0,
            billow: (0.0, 0.0),
        };
        self.clouds.push(lamp(0.6 * size_m, [2.2, 0.95, 0.16]));
        self.clouds.push(lamp(1.6 * size_m, [0.22, 0.09, 0.015]));
        self.add_trunk(foot, 1.2 * size_m, 0.08 * size_m);
    }

    /// Two white lamps at the front of a car, and the haze that they light up.
    pub(crate) fn add_headlamps(&mut self, foot: Vector3<f64>, size_m: f64, seed: u64) {
        let (along, across) = turned(seed, size_m, 0.42 * size_m);
        let bumper = foot + along * 0.52 + Vector3::z() * (0.15 * size_m);
        for side in [-0.36, 0.36] {
            let lamp = |half: f64, colour: [f32; 3]| Splat {
                kind: SplatKind::Light,
                centre_m: bumper + across * side,
                half_axis_m: Vector3::z() * half,
                half_width_m: half,
                colour,
                opacity: 0.0,
                billow: (0.0, 0.0),
            };
            self.clouds.push(lamp(0.03 * size_m, [6.0, 5.4, 4.2]));
            self.clouds.push(lamp(0.11 * size_m, [0.5, 0.44, 0.33]));
        }
    }

    /// A low bank of fog: soft, flat, white.
    pub(crate) fn add_fog(&mut self, foot: Vector3<f64>, size_m: f64, seed: u64, colour: [f32; 3]) {
        for k in 0..24 {
            let (sin, cos) = (TAU * unit(seed, k, 1)).sin_cos();
            let out = 0.5 * size_m * unit(seed, k, 2).sqrt();
            let half = size_m * (0.09 + 0.08 * unit(seed, k, 3));
            let up = half * (0.6 + 0.6 * unit(seed, k, 4));
            self.clouds.push(Splat {
                kind: SplatKind::Smoke,
                centre_m: foot + Vector3::new(out * cos, 0.6 * out * sin, up),
                half_axis_m: Vector3::z() * (0.7 * half),
                half_width_m: half,
                colour: colour.map(|c| c * (0.9 + 0.2 * unit(seed, k, 5) as f32)),
                opacity: 0.35,
                billow: (unit(seed, k, 6) as f32, unit(seed, k, 7) as f32),
            });
        }
    }

    /// A puddle that glitters.
    pub(crate) fn add_puddle(&mut self, foot: Vector3<f64>, size_m: f64, seed: u64) {
        let radius_m = 0.5 * size_m;
        self.marks.push(Mark {
            kind: MarkKind::Puddle,
            centre_m: foot.xy(),
            radius_m,
        });
        self.glints.push(Glint {
            seed,
            centre_m: foot,
            radius_m,
        });
    }
}

fn turned(seed: u64, along_m: f64, across_m: f64) -> (Vector3<f64>, Vector3<f64>) {
    let (sin, cos) = (TAU * unit(seed, 0, 30)).sin_cos();
    (
        Vector3::new(cos, sin, 0.0) * along_m,
        Vector3::new(-sin, cos, 0.0) * across_m,
    )
}

/// Mostly green; one in six has turned orange or brown, which is what a detector must bear.
fn leaf_albedo(seed: u64) -> [f32; 3] {
    let light = 0.7 + 0.6 * unit(seed, 0, 41) as f32;
    let leaf = match (unit(seed, 0, 40) * 12.0) as u32 {
        0 => [0.36, 0.14, 0.03],
        1 => [0.30, 0.22, 0.06],
        2..5 => [0.13, 0.15, 0.05],
        _ => [0.06, 0.11, 0.03],
    };
    leaf.map(|a| a * light)
}
