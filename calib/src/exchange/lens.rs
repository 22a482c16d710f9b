//! Other lens models, and the five-term one nearest to them.

use super::ImportError;
use crate::Camera;
use nalgebra::{DMatrix, DVector};
use std::path::Path;

/// Greatest miss of a lens brought to five terms, pixels: below what corners are found to.
pub const REFIT_LIMIT_PX: f64 = 0.1;

/// A lens in a file.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Lens {
    /// OpenCV's: k1 k2 p1 p2, k3, k4 k5 k6, s1 s2 s3 s4, tilt x y; as many as there are.
    Brown(Vec<f64>),
    /// Kannala and Brandt's ("equidistant", OpenCV's fisheye): four terms.
    Equidistant([f64; 4]),
}

pub(super) struct Pinhole {
    pub size: (u32, u32),
    pub focal_px: (f64, f64),
    pub principal_point_px: (f64, f64),
}

/// A camera of five terms, and a note if terms were lost on the way.
pub(super) fn camera(
    path: &Path,
    key: &str,
    pinhole: &Pinhole,
    lens: &Lens,
) -> Result<(Camera, Option<String>), ImportError> {
    let mut camera = Camera {
        image_size_px: pinhole.size,
        focal_px: pinhole.focal_px,
        principal_point_px: pinhole.principal_point_px,
        distortion: [0.0; 5],
    };
    if let Lens::Brown(terms) = lens
        && terms.iter().skip(5).all(|term| *term == 0.0)
    {
        for (term, value) in camera.distortion.iter_mut().zip(terms) {
            *term = *value;
        }
        return Ok((camera, None));
    }
    let missed_px = refit(&mut camera, lens);
    let model = lens.name();
    if missed_px.is_nan() || missed_px > REFIT_LIMIT_PX {
        return Err(ImportError::Lens {
            path: path.to_owned(),
            key: key.to_owned(),
            model,
            missed_px,
        });
    }
    let note =
        format!("{key}: {model} was brought to five terms, missed by {missed_px:.3} px at most");
    Ok((camera, Some(note)))
}

impl Lens {
    fn name(&self) -> String {
        match self {
            Self::Brown(terms) => format!("with {} terms", terms.len()),
            Self::Equidistant(_) => "equidistant".to_owned(),
        }
    }

    /// Where the lens puts a ray (x, y, 1), in units of the focal length.
    fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        match self {
            Self::Brown(terms) => brown(terms, x, y),
            Self::Equidistant(terms) => equidistant(terms, x, y),
        }
    }
}

fn brown(terms: &[f64], x: f64, y: f64) -> (f64, f64) {
    let term = |index: usize| terms.get(index).copied().unwrap_or(0.0);
    let r2 = x * x + y * y;
    let power = |a: f64, b: f64, c: f64| 1.0 + r2 * (a + r2 * (b + r2 * c));
    let radial = power(term(0), term(1), term(4)) / power(term(5), term(6), term(7));
    let (p1, p2) = (term(2), term(3));
    (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (term(8) + r2 * term(9)),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (term(10) + r2 * term(11)),
    )
}

fn equidistant(terms: &[f64; 4], x: f64, y: f64) -> (f64, f64) {
    let r = x.hypot(y);
    if r < 1e-12 {
        return (x, y);
    }
    let angle = r.atan();
    let a2 = angle * angle;
    let bent = angle * (1.0 + a2 * (terms[0] + a2 * (terms[1] + a2 * (terms[2] + a2 * terms[3]))));
    (x * bent / r, y * bent / r)
}

/// Rays on a grid whose pixels lie in the image: what both models must agree on.
fn rays(camera: &Camera, lens: &Lens) -> Vec<(f64, f64)> {
    const STEPS: i32 = 60;
    // Barrel distortion brings in rays from beyond the image's own angle.
    const BEYOND: f64 = 3.0;
    let (width, height) = camera.image_size_px;
    let reach = |pixels: u32, focal: f64| BEYOND * f64::from(pixels) / (2.0 * focal);
    let (reach_x, reach_y) = (
        reach(width, camera.focal_px.0),
        reach(height, camera.focal_px.1),
    );
    let inside = |value: f64, pixels: u32| (-0.5..f64::from(pixels) - 0.5).contains(&value);
    let share = |step: i32| f64::from(step) / f64::from(STEPS);
    (-STEPS..=STEPS)
        .flat_map(|i| (-STEPS..=STEPS).map(move |j| (share(i) * reach_x, share(j) * reach_y)))
        .filter(|&(x, y)| {
            let (xd, yd) = lens.distort(x, y);
            inside(camera.focal_px.0 * xd + camera.principal_point_px.0, width)
                && inside(camera.focal_px.1 * yd + camera.principal_point_px.1, height)
        })
        .collect()
}

/// Sets the five terms by linear least squares; returns the greatest miss, pixels.
fn refit(camera: &mut Camera, lens: &Lens) -> f64 {
    let rays = rays(camera, lens);
    let (fx, fy) = camera.focal_px;
    let mut matrix = DMatrix::zeros(2 * rays.len(), 5);
    let mut wanted = DVector::zeros(2 * rays.len());
    for (index, &(x, y)) in rays.iter().enumerate() {
        let r2 = x * x + y * y;
        let (r4, r6) = (r2 * r2, r2 * r2 * r2);
        let (xd, yd) = lens.distort(x, y);
        let row_x = [x * r2, x * r4, 2.0 * x * y, r2 + 2.0 * x * x, x * r6];
        let row_y = [y * r2, y * r4, r2 + 2.0 * y * y, 2.0 * x * y, y * r6];
        for term in 0..5 {
            matrix[(2 * index, term)] = fx * row_x[term];
            matrix[(2 * index + 1, term)] = fy * row_y[term];
        }
        wanted[2 * index] = fx * (xd - x);
        wanted[2 * index + 1] = fy * (yd - y);
    }
    let Ok(terms) = matrix.clone().svd(true, true).solve(&wanted, 1e-12) else {
        return f64::NAN;
    };
    for (term, value) in camera.distortion.iter_mut().zip(terms.iter()) {
        *term = *value;
    }
    (&matrix * terms - wanted).amax()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PINHOLE: Pinhole = Pinhole {
        size: (1280, 720),
        focal_px: (880.0, 881.0),
        principal_point_px: (643.0, 357.0),
    };

    #[test]
    fn a_mild_rational_lens_is_followed_and_a_fisheye_refused() {
        let path = Path::new("x");
        let rational = Lens::Brown(vec![0.1, 0.02, 1e-4, -2e-4, 0.001, 0.15, 0.01, 0.0]);
        let (camera, note) = camera(path, "left", &PINHOLE, &rational).unwrap();
        assert!(note.unwrap().contains("8 terms"));
        let seen = camera.project(&emberfix_frames::Vector3::new(0.4, 0.2, 1.0));
        let (x, y) = rational.distort(0.4, 0.2);
        assert!((seen.u - (880.0 * x + 643.0)).abs() < REFIT_LIMIT_PX);
        assert!((seen.v - (881.0 * y + 357.0)).abs() < REFIT_LIMIT_PX);

        let wide = Pinhole {
            focal_px: (300.0, 300.0),
            ..PINHOLE
        };
        let error = super::camera(
            path,
            "left",
            &wide,
            &Lens::Equidistant([0.01, 0.0, 0.0, 0.0]),
        );
        assert!(error.unwrap_err().to_string().contains("missed by"));
    }

    #[test]
    fn five_terms_are_taken_as_they_are() {
        let terms = vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0];
        let (camera, note) = camera(Path::new("x"), "left", &PINHOLE, &Lens::Brown(terms)).unwrap();
        assert_eq!(camera.distortion, [0.1, 0.2, 0.3, 0.4, 0.5]);
        assert_eq!(note, None);
    }
}
