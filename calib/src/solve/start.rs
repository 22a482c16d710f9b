//! Where the joint problem begins: Zhang's method for each eye, and the pair from the view that
//! agrees best with all others.

use super::state::{BoardPose, State, Step};
use super::{Board, Corner, SolveError, View};
use crate::Camera;
use emberfix_frames::{Matrix3, UnitQuaternion, Vector3};
use opencv::calib3d;
use opencv::core::{Mat, MatTraitConstManual, Point2f, Point3f, Size, TermCriteria, Vector};

struct Eye {
    camera: Camera,
    boards: Vec<BoardPose>,
}

pub(super) fn start(
    board: &Board,
    views: &[View],
    image_size_px: (u32, u32),
) -> Result<State, SolveError> {
    let left = eye(board, views.iter().map(|view| &view.left), image_size_px)?;
    let right = eye(board, views.iter().map(|view| &view.right), image_size_px)?;
    let (right_from_left, translation_m) = pair(&left.boards, &right.boards);
    Ok(State {
        left: left.camera,
        right: right.camera,
        right_from_left,
        translation_m,
        uneven_m: vec![Vector3::zeros(); board.corners()],
        steps: vec![Step::default(); views.len()],
        boards: left.boards,
    })
}

fn eye<'a>(
    board: &Board,
    views: impl Iterator<Item = &'a Vec<Corner>>,
    (width, height): (u32, u32),
) -> Result<Eye, SolveError> {
    let mut object_points = Vector::<Vector<Point3f>>::new();
    let mut image_points = Vector::<Vector<Point2f>>::new();
    for corners in views {
        let on_board = corners.iter().map(|corner| board.point_m(corner.id));
        object_points.push(
            on_board
                .map(|p| Point3f::new(p.x as f32, p.y as f32, p.z as f32))
                .collect(),
        );
        let pixels = corners.iter().map(|corner| corner.pixel);
        image_points.push(
            pixels
                .map(|p| Point2f::new(p.u as f32, p.v as f32))
                .collect(),
        );
    }
    let (mut matrix, mut distortion) = (Mat::default(), Mat::default());
    let mut rotations = Vector::<Mat>::new();
    let mut translations = Vector::<Mat>::new();
    calib3d::calibrate_camera_extended(
        &object_points,
        &image_points,
        Size::new(width as i32, height as i32),
        &mut matrix,
        &mut distortion,
        &mut rotations,
        &mut translations,
        &mut Mat::default(),
        &mut Mat::default(),
        &mut Mat::default(),
        0,
        TermCriteria::new(3, 30, 1e-9)?,
    )?;
    let boards = rotations.iter().zip(&translations);
    Ok(Eye {
        camera: camera(&matrix, &distortion, (width, height))?,
        boards: boards
            .map(|(rotation, origin)| pose(&rotation, &origin))
            .collect::<opencv::Result<_>>()?,
    })
}

fn camera(matrix: &Mat, distortion: &Mat, size: (u32, u32)) -> opencv::Result<Camera> {
    let k = matrix.data_typed::<f64>()?;
    let mut terms = [0.0; 5];
    for (term, value) in terms.iter_mut().zip(distortion.data_typed::<f64>()?) {
        *term = *value;
    }
    Ok(Camera {
        image_size_px: size,
        focal_px: (k[0], k[4]),
        principal_point_px: (k[2], k[5]),
        distortion: terms,
    })
}

fn pose(rotation: &Mat, origin: &Mat) -> opencv::Result<BoardPose> {
    let turn = Vector3::from_column_slice(rotation.data_typed::<f64>()?);
    Ok(BoardPose {
        left_from_board: UnitQuaternion::from_scaled_axis(turn)
            .to_rotation_matrix()
            .into_inner(),
        origin_m: Vector3::from_column_slice(origin.data_typed::<f64>()?),
    })
}

/// The relative pose of one view that lies nearest to all views': bad views can't pull it.
fn pair(left: &[BoardPose], right: &[BoardPose]) -> (Matrix3<f64>, Vector3<f64>) {
    let relative: Vec<(Matrix3<f64>, Vector3<f64>)> = left
        .iter()
        .zip(right)
        .map(|(left, right)| {
            let turn = right.left_from_board * left.left_from_board.transpose();
            (turn, right.origin_m - turn * left.origin_m)
        })
        .collect();
    let away = |a: &(Matrix3<f64>, Vector3<f64>), b: &(Matrix3<f64>, Vector3<f64>)| {
        (a.0 - b.0).norm() + (a.1 - b.1).norm()
    };
    let total = |candidate| {
        relative
            .iter()
            .map(|other| away(candidate, other))
            .sum::<f64>()
    };
    relative
        .iter()
        .min_by(|a, b| total(a).total_cmp(&total(b)))
        .copied()
        .unwrap_or((Matrix3::identity(), Vector3::zeros()))
}
