//! Pictures of a chessboard through a lens: each pixel's ray is cut with the board's plane, sixteen
//! times a pixel, then blurred and made noisy. The lens is inverted here by Newton's method, apart from
//! OpenCV's way.

use emberfix_calib::Camera;
use emberfix_calib::solve::Board;
use emberfix_frames::{Matrix3, Vector3};
use opencv::core::{Mat, MatTraitConst, Size};
use opencv::imgproc;
use rand::Rng;
use rand_distr::{Distribution, Normal};

/// How an eye sees.
#[derive(Debug, Clone, Copy)]
pub struct Sight {
    /// Grey of black and of white squares.
    pub grey: (f64, f64),
    /// Sigma of the blur, pixels.
    pub blur_px: f64,
    /// Sigma of the noise, grey levels.
    pub noise: f64,
}

/// Daylight on a good sensor.
pub const VISIBLE: Sight = Sight {
    grey: (35.0, 205.0),
    blur_px: 0.7,
    noise: 2.0,
};

/// P4's near-infrared eye: softer, noisier, and the ink is hardly darker than the paper.
pub const NEAR_INFRARED: Sight = Sight {
    grey: (80.0, 150.0),
    blur_px: 1.0,
    noise: 4.0,
};

/// The paper: how it departs from a plane.
#[derive(Debug, Clone, Copy, Default)]
pub struct Paper {
    /// Curvatures along rows, along the diagonal, and along columns, 1/m.
    pub bend_per_m: [f64; 3],
    /// Height of its waves, metres.
    pub waves_m: f64,
}

impl Paper {
    /// Length of a wave, metres.
    const WAVE_M: f64 = 0.07;

    /// Height over the plane, away from the camera, at a place seen from the board's middle.
    fn height_m(self, x: f64, y: f64) -> f64 {
        let [along, across, down] = self.bend_per_m;
        let bent = 0.5 * (along * x * x + across * x * y + down * y * y);
        let phase = std::f64::consts::TAU / Self::WAVE_M;
        bent + self.waves_m * (phase * x).sin() * (phase * y + 1.0).cos()
    }
}

/// A board at a pose: board to camera.
#[derive(Debug, Clone, Copy)]
pub struct Held<'a> {
    pub board: &'a Board,
    pub paper: Paper,
    pub turn: Matrix3<f64>,
    pub origin_m: Vector3<f64>,
}

/// Where rays meet the board.
struct Meeting {
    to_board: Matrix3<f64>,
    /// The camera in board axes, metres.
    camera_m: Vector3<f64>,
    middle_m: Vector3<f64>,
    paper: Paper,
    square_m: f64,
}

impl Meeting {
    fn of(held: &Held<'_>) -> Self {
        let (turn, origin) = (&held.turn, held.origin_m);
        let plane = Matrix3::from_columns(&[turn.column(0).into(), turn.column(1).into(), origin]);
        Self {
            // Board plane (x, y, 1) to camera; its inverse takes rays to the board.
            to_board: plane.try_inverse().unwrap_or_else(Matrix3::identity),
            camera_m: -(turn.transpose() * origin),
            middle_m: held.board.middle_m(),
            paper: held.paper,
            square_m: held.board.square_m,
        }
    }

    /// On the plane, in squares from the first inner corner.
    fn on_plane(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let m = self.to_board.as_slice();
        let scale = ((m[2] * x + m[5] * y + m[8]) * self.square_m).recip();
        (
            (m[0] * x + m[3] * y + m[6]) * scale,
            (m[1] * x + m[4] * y + m[7]) * scale,
        )
    }

    /// On the paper, in squares from the first inner corner: along the ray from the plane to its height,
    /// which changes little on the way.
    fn on_paper(&self, ray: (f64, f64)) -> (f64, f64) {
        let flat = self.on_plane(ray);
        let (mut a, mut b) = flat;
        for _ in 0..2 {
            let (x, y) = (a * self.square_m, b * self.square_m);
            let height = self
                .paper
                .height_m(x - self.middle_m.x, y - self.middle_m.y);
            let share = height / self.camera_m.z;
            a = flat.0 + (self.camera_m.x / self.square_m - flat.0) * share;
            b = flat.1 + (self.camera_m.y / self.square_m - flat.1) * share;
        }
        (a, b)
    }
}

/// The rays of all pixels of a camera: x and y at depth 1.
pub struct Rays {
    size: (usize, usize),
    xy: Vec<(f64, f64)>,
}

impl Rays {
    pub fn of(camera: &Camera) -> Self {
        let (width, height) = camera.image_size_px;
        let size = (width as usize, height as usize);
        let mut xy = Vec::with_capacity(size.0 * size.1);
        for row in 0..size.1 {
            let mut guess = None;
            for column in 0..size.0 {
                let ray = ray(camera, column as f64, row as f64, guess);
                guess = Some(ray);
                xy.push(ray);
            }
        }
        Self { size, xy }
    }

    fn at(&self, column: usize, row: usize) -> (f64, f64) {
        self.xy[row * self.size.0 + column]
    }

    /// The ray, and how it changes from one column and from one row to the next.
    fn with_slopes(&self, column: usize, row: usize) -> [(f64, f64); 3] {
        let here = self.at(column, row);
        let (left, right) = (column.max(1) - 1, (column + 1).min(self.size.0 - 1));
        let (up, down) = (row.max(1) - 1, (row + 1).min(self.size.1 - 1));
        let slope = |a: (f64, f64), b: (f64, f64), steps: usize| {
            ((b.0 - a.0) / steps as f64, (b.1 - a.1) / steps as f64)
        };
        [
            here,
            slope(self.at(left, row), self.at(right, row), right - left),
            slope(self.at(column, up), self.at(column, down), down - up),
        ]
    }
}

/// Newton's method on the camera's own projection.
fn ray(camera: &Camera, u: f64, v: f64, guess: Option<(f64, f64)>) -> (f64, f64) {
    let (fx, fy) = camera.focal_px;
    let (mut x, mut y) = guess.unwrap_or((
        (u - camera.principal_point_px.0) / fx,
        (v - camera.principal_point_px.1) / fy,
    ));
    for _ in 0..12 {
        let project = |x, y| camera.project(&Vector3::new(x, y, 1.0));
        let here = project(x, y);
        let (off_u, off_v) = (u - here.u, v - here.v);
        if off_u.hypot(off_v) < 1e-9 {
            break;
        }
        const STEP: f64 = 1e-6;
        let (by_x, by_y) = (project(x + STEP, y), project(x, y + STEP));
        let (a, b) = ((by_x.u - here.u) / STEP, (by_y.u - here.u) / STEP);
        let (c, d) = ((by_x.v - here.v) / STEP, (by_y.v - here.v) / STEP);
        let determinant = a * d - b * c;
        x += (d * off_u - b * off_v) / determinant;
        y += (a * off_v - c * off_u) / determinant;
    }
    (x, y)
}

/// Samples along each side of a pixel.
const SAMPLES: usize = 4;
/// White paper around the pattern, squares.
const MARGIN: f64 = 1.0;

/// The board as the eye sees it; grey, 8 bit.
///
/// # Errors
/// What OpenCV says.
pub fn render(
    rays: &Rays,
    held: &Held<'_>,
    sight: Sight,
    random: &mut impl Rng,
) -> opencv::Result<Mat> {
    let (width, height) = rays.size;
    let meeting = Meeting::of(held);
    let background = 0.5 * (sight.grey.0 + sight.grey.1);
    let tilt = random.random_range(-0.15..0.15);
    let mut pixels = vec![0.0_f32; width * height];
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (column, row) = (index % width, index / width);
        let light = 1.0 + tilt * (column as f64 / width as f64 - 0.5);
        let grey = if near_board(&meeting, held.board, rays.at(column, row)) {
            let slopes = rays.with_slopes(column, row);
            sampled(&meeting, held.board, slopes, sight, background)
        } else {
            background
        };
        *pixel = (grey * light) as f32;
    }
    finish(&pixels, height as i32, sight, random)
}

fn near_board(meeting: &Meeting, board: &Board, ray: (f64, f64)) -> bool {
    let (a, b) = meeting.on_plane(ray);
    let reach = 1.0 + MARGIN + 1.0;
    (-reach..board.columns as f64 + reach).contains(&a)
        && (-reach..board.rows as f64 + reach).contains(&b)
}

fn sampled(
    meeting: &Meeting,
    board: &Board,
    [ray, by_column, by_row]: [(f64, f64); 3],
    sight: Sight,
    background: f64,
) -> f64 {
    let mut sum = 0.0;
    for i in 0..SAMPLES {
        for j in 0..SAMPLES {
            let across = (i as f64 + 0.5) / SAMPLES as f64 - 0.5;
            let down = (j as f64 + 0.5) / SAMPLES as f64 - 0.5;
            let sample = (
                ray.0 + across * by_column.0 + down * by_row.0,
                ray.1 + across * by_column.1 + down * by_row.1,
            );
            sum += grey_at(meeting.on_paper(sample), board, sight, background);
        }
    }
    sum / (SAMPLES * SAMPLES) as f64
}

/// The pattern: the square between the first four inner corners is dark.
fn grey_at((a, b): (f64, f64), board: &Board, sight: Sight, background: f64) -> f64 {
    let (columns, rows) = (board.columns as f64, board.rows as f64);
    let within = |margin: f64| {
        (-1.0 - margin..columns + margin).contains(&a)
            && (-1.0 - margin..rows + margin).contains(&b)
    };
    if !within(MARGIN) {
        background
    } else if !within(0.0) || (a.floor() + b.floor()).rem_euclid(2.0) == 1.0 {
        sight.grey.1
    } else {
        sight.grey.0
    }
}

fn finish(pixels: &[f32], rows: i32, sight: Sight, random: &mut impl Rng) -> opencv::Result<Mat> {
    let sharp = Mat::from_slice(pixels)?;
    let sharp = sharp.reshape(1, rows)?;
    let mut soft = Mat::default();
    let blur = Size::new(0, 0);
    imgproc::gaussian_blur_def(&sharp, &mut soft, blur, sight.blur_px)?;
    let mut bytes = Vec::with_capacity(pixels.len());
    let noise = Normal::new(0.0, sight.noise).ok();
    use opencv::prelude::MatTraitConstManual;
    for grey in soft.data_typed::<f32>()? {
        let noise = noise.map_or(0.0, |noise| noise.sample(random));
        bytes.push((f64::from(*grey) + noise).round().clamp(0.0, 255.0) as u8);
    }
    Ok(Mat::from_slice(&bytes)?.reshape(1, rows)?.clone_pointee())
}
