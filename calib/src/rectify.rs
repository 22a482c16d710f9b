//! Bouguet rectification by OpenCV, and the way of a pixel into the rectified pair and back.

use crate::{Camera, Eye, RawPixel, RectifiedPixel};
use emberfix_frames::{Matrix3, Vector3};
use opencv::core::{CV_32FC1, Mat, MatTraitConst, Point2d, Size, Vector as CvVector};
use opencv::prelude::MatTraitConstManual;
use opencv::{Result, calib3d};

/// What `stereoRectify` found: both cameras turned parallel, with one focal length.
#[derive(Debug, Clone, PartialEq)]
pub struct Rectification {
    rectified_from_raw: [Matrix3<f64>; 2],
    projection: [Matrix3<f64>; 2],
    cameras: [Camera; 2],
}

/// Terms that decide when undistorting one point has converged.
const UNDISTORT_EPSILON_PX: f64 = 1e-9;

impl Rectification {
    pub(crate) fn new(
        left: &Camera,
        right: &Camera,
        right_from_left: &Matrix3<f64>,
        translation_m: &Vector3<f64>,
    ) -> Result<Self> {
        let (mut r1, mut r2, mut p1, mut p2, mut q) = (
            Mat::default(),
            Mat::default(),
            Mat::default(),
            Mat::default(),
            Mat::default(),
        );
        let (width, height) = left.image_size_px;
        calib3d::stereo_rectify(
            &camera_matrix(left)?,
            &distortion(left)?,
            &camera_matrix(right)?,
            &distortion(right)?,
            Size::new(width as i32, height as i32),
            &matrix_to_mat(right_from_left)?,
            &Mat::from_slice(translation_m.as_slice())?.reshape(1, 3)?,
            &mut r1,
            &mut r2,
            &mut p1,
            &mut p2,
            &mut q,
            calib3d::CALIB_ZERO_DISPARITY,
            0.0,
            Size::default(),
            None,
            None,
        )?;
        Ok(Self {
            rectified_from_raw: [mat_to_matrix(&r1)?, mat_to_matrix(&r2)?],
            projection: [mat_to_matrix(&p1)?, mat_to_matrix(&p2)?],
            cameras: [left.clone(), right.clone()],
        })
    }

    /// Takes raw camera components of an eye to rectified ones (OpenCV's R1, R2).
    #[must_use]
    pub fn rectified_from_raw(&self, eye: Eye) -> &Matrix3<f64> {
        &self.rectified_from_raw[index(eye)]
    }

    /// The left block of the rectified projection of an eye (OpenCV's P1, P2), pixels.
    #[must_use]
    pub fn projection(&self, eye: Eye) -> &Matrix3<f64> {
        &self.projection[index(eye)]
    }

    /// Focal length of the rectified pair, pixels.
    #[must_use]
    pub fn focal_px(&self) -> f64 {
        self.projection[0][(0, 0)]
    }

    /// Principal point of the rectified left image: column, row.
    #[must_use]
    pub fn principal_point_px(&self) -> (f64, f64) {
        (self.projection[0][(0, 2)], self.projection[0][(1, 2)])
    }

    /// Disparity of a point at infinity (0 when both principal points agree), pixels.
    #[must_use]
    pub fn infinity_disparity_px(&self) -> f64 {
        self.projection[0][(0, 2)] - self.projection[1][(0, 2)]
    }

    /// Angle in radians by which rectification turns an eye; large means a rig that is bent.
    #[must_use]
    pub fn turn_rad(&self, eye: Eye) -> f64 {
        let trace = self.rectified_from_raw(eye).trace();
        ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos()
    }

    /// Raw pixels to rectified pixels.
    ///
    /// # Errors
    /// What OpenCV says, which for finite pixels is nothing.
    pub fn rectify(&self, eye: Eye, pixels: &[RawPixel]) -> Result<Vec<RectifiedPixel>> {
        let camera = &self.cameras[index(eye)];
        let points: CvVector<Point2d> = pixels.iter().map(|p| Point2d::new(p.u, p.v)).collect();
        let mut rectified = CvVector::<Point2d>::new();
        calib3d::undistort_points_iter(
            &points,
            &mut rectified,
            &camera_matrix(camera)?,
            &distortion(camera)?,
            &matrix_to_mat(self.rectified_from_raw(eye))?,
            &matrix_to_mat(&self.projection[index(eye)])?,
            opencv::core::TermCriteria::new(3, 50, UNDISTORT_EPSILON_PX)?,
        )?;
        Ok(rectified
            .iter()
            .map(|p| RectifiedPixel { u: p.x, v: p.y })
            .collect())
    }

    /// Rectified pixels to raw pixels, in closed form (the camera model forwards).
    #[must_use]
    pub fn unrectify(&self, eye: Eye, pixel: RectifiedPixel) -> RawPixel {
        let projection = &self.projection[index(eye)];
        let ray = Vector3::new(
            (pixel.u - projection[(0, 2)]) / projection[(0, 0)],
            (pixel.v - projection[(1, 2)]) / projection[(1, 1)],
            1.0,
        );
        let raw = self.rectified_from_raw(eye).transpose() * ray;
        self.cameras[index(eye)].project(&raw)
    }

    /// The two `remap` maps (columns, rows; 32-bit float) that rectify a whole image of an eye.
    ///
    /// # Errors
    /// What OpenCV says.
    pub fn maps(&self, eye: Eye) -> Result<(Mat, Mat)> {
        let camera = &self.cameras[index(eye)];
        let (width, height) = self.cameras[0].image_size_px;
        let (mut columns, mut rows) = (Mat::default(), Mat::default());
        calib3d::init_undistort_rectify_map(
            &camera_matrix(camera)?,
            &distortion(camera)?,
            &matrix_to_mat(self.rectified_from_raw(eye))?,
            &matrix_to_mat(&self.projection[index(eye)])?,
            Size::new(width as i32, height as i32),
            CV_32FC1,
            &mut columns,
            &mut rows,
        )?;
        Ok((columns, rows))
    }
}

impl Camera {
    /// Projects a point in raw camera components (any unit, Z above 0) to a raw pixel, with
    /// OpenCV's five-term distortion.
    #[must_use]
    pub fn project(&self, point: &Vector3<f64>) -> RawPixel {
        let (x, y) = (point.x / point.z, point.y / point.z);
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        RawPixel {
            u: self.focal_px.0 * xd + self.principal_point_px.0,
            v: self.focal_px.1 * yd + self.principal_point_px.1,
        }
    }
}

fn index(eye: Eye) -> usize {
    match eye {
        Eye::Left => 0,
        Eye::Right => 1,
    }
}

fn camera_matrix(camera: &Camera) -> Result<Mat> {
    let ((fx, fy), (cx, cy)) = (camera.focal_px, camera.principal_point_px);
    matrix_to_mat(&Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0))
}

fn distortion(camera: &Camera) -> Result<Mat> {
    Ok(Mat::from_slice(&camera.distortion)?.clone_pointee())
}

fn matrix_to_mat(matrix: &Matrix3<f64>) -> Result<Mat> {
    // Column-major here, row-major there.
    Ok(Mat::from_slice(matrix.transpose().as_slice())?
        .reshape(1, 3)?
        .clone_pointee())
}

/// The left 3x3 block of a 3x3 or 3x4 matrix.
fn mat_to_matrix(mat: &Mat) -> Result<Matrix3<f64>> {
    let mut matrix = Matrix3::zeros();
    for row in 0..3 {
        let values = mat.at_row::<f64>(row)?;
        for (column, value) in values.iter().take(3).enumerate() {
            matrix[(row as usize, column)] = *value;
        }
    }
    Ok(matrix)
}
