//! Corners in one image, numbered the same way in every image.

use super::{Board, Corner, View, charuco};
use crate::RawPixel;
use emberfix_frames::Vector2;
use opencv::core::{Mat, MatTraitConst, Point2f, Size, TermCriteria, Vector};
use opencv::{Result, calib3d, imgcodecs, imgproc};

/// The board's corners in a grey image (8 bit, one channel); `None` where it is not seen: a chessboard
/// whole, a ChArUco board enough of it to count.
///
/// A dim or flat image (a near-infrared eye's, say) gets a second look with its contrast raised.
///
/// # Errors
/// What OpenCV says, of an image in another format.
pub fn find_corners(image: &Mat, board: &Board) -> Result<Option<Vec<Corner>>> {
    if let Some(corners) = look(image, image, board)? {
        return Ok(Some(corners));
    }
    let mut raised = Mat::default();
    imgproc::create_clahe(4.0, Size::new(8, 8)).and_then(|mut clahe| {
        use opencv::prelude::CLAHETrait;
        clahe.apply(image, &mut raised)
    })?;
    look(&raised, image, board)
}

/// Finds in one version of the image, refines in the untouched one.
fn look(contrasted: &Mat, image: &Mat, board: &Board) -> Result<Option<Vec<Corner>>> {
    if let Some(markers) = board.markers {
        return charuco::find(contrasted, image, board, markers);
    }
    let mut points = Vector::<Point2f>::new();
    let flags = calib3d::CALIB_CB_ADAPTIVE_THRESH
        + calib3d::CALIB_CB_NORMALIZE_IMAGE
        + calib3d::CALIB_CB_FAST_CHECK;
    let size = Size::new(board.columns as i32, board.rows as i32);
    if !calib3d::find_chessboard_corners(contrasted, size, &mut points, flags)? {
        return Ok(None);
    }
    let spacing_px = spacing_px(&points, board.columns);
    refine(image, &mut points, spacing_px)?;
    let mut pixels: Vec<RawPixel> = points.iter().map(raw).collect();
    number_from_dark(image, board, &mut pixels)?;
    let corners = pixels.into_iter().enumerate();
    Ok(Some(
        corners.map(|(id, pixel)| Corner { id, pixel }).collect(),
    ))
}

fn raw(point: Point2f) -> RawPixel {
    RawPixel {
        u: f64::from(point.x),
        v: f64::from(point.y),
    }
}

/// The least way from one corner to the next in its row or column.
fn spacing_px(points: &Vector<Point2f>, columns: usize) -> f64 {
    let points: Vec<Point2f> = points.iter().collect();
    let way = |a: Point2f, b: Point2f| (a - b).norm();
    let in_rows = points
        .chunks(columns)
        .flat_map(|row| row.windows(2).map(|pair| way(pair[0], pair[1])));
    let in_columns = points
        .iter()
        .zip(points.iter().skip(columns))
        .map(|(a, b)| way(*a, *b));
    in_rows.chain(in_columns).fold(f64::INFINITY, f64::min)
}

/// Share of a square that the refining window's half reaches: the longest edges that belong to no other
/// corner's window, and so the least noise.
const WINDOW_SHARE: f64 = 0.5;

/// Moves the corners to where the image's gradients point, in a window that fits the squares.
fn refine(image: &Mat, points: &mut Vector<Point2f>, spacing_px: f64) -> Result<()> {
    let half = (spacing_px * WINDOW_SHARE).clamp(2.0, 11.0) as i32;
    imgproc::corner_sub_pix(
        image,
        points,
        Size::new(half, half),
        Size::new(-1, -1),
        TermCriteria::new(3, 60, 1e-4)?,
    )
}

/// Rows run clockwise to columns, and the first square is dark where the pattern lets us choose.
fn number_from_dark(image: &Mat, board: &Board, pixels: &mut [RawPixel]) -> Result<()> {
    let (columns, rows) = (board.columns, board.rows);
    let (first, along, down) = (pixels[0], pixels[columns - 1], pixels[columns * (rows - 1)]);
    let (along, down) = (minus(along, first), minus(down, first));
    if along.x * down.y - along.y * down.x < 0.0 {
        pixels.chunks_mut(columns).for_each(<[RawPixel]>::reverse);
    }
    if board.has_one_way_up() && !first_is_dark(image, columns, rows, pixels)? {
        pixels.reverse();
    }
    Ok(())
}

fn minus(a: RawPixel, b: RawPixel) -> Vector2<f64> {
    Vector2::new(a.u - b.u, a.v - b.v)
}

/// Compares all squares of the first one's colour with all others.
fn first_is_dark(image: &Mat, columns: usize, rows: usize, pixels: &[RawPixel]) -> Result<bool> {
    let mut sums = [0.0, 0.0];
    for row in 0..rows - 1 {
        for column in 0..columns - 1 {
            let at = row * columns + column;
            let four = [at, at + 1, at + columns, at + columns + 1];
            let u = four.iter().map(|&i| pixels[i].u).sum::<f64>() / 4.0;
            let v = four.iter().map(|&i| pixels[i].v).sum::<f64>() / 4.0;
            let grey = f64::from(*image.at_2d::<u8>(v.round() as i32, u.round() as i32)?);
            sums[(row + column) % 2] += grey;
        }
    }
    let squares = (rows - 1) * (columns - 1);
    let even = squares.div_ceil(2);
    Ok(sums[0] / even as f64 <= sums[1] / ((squares - even).max(1)) as f64)
}

/// Numbers a chessboard that looks the same after half a turn alike in both eyes, and keeps only
/// what both of them see.
#[must_use]
pub fn make_consistent(board: &Board, mut view: View) -> View {
    if !board.has_one_way_up() && view.left.len() == view.right.len() {
        let direction = |corners: &[Corner]| match (corners.first(), corners.last()) {
            (Some(first), Some(last)) => minus(last.pixel, first.pixel),
            _ => Vector2::zeros(),
        };
        if direction(&view.left).dot(&direction(&view.right)) < 0.0 {
            let last = view.right.len() - 1;
            for corner in &mut view.right {
                corner.id = last - corner.id;
            }
            view.right.reverse();
        }
    }
    view
}

/// Reads an image file as 8-bit grey; `None` where it is no image.
///
/// # Errors
/// What OpenCV says.
pub fn read_grey(path: &std::path::Path) -> Result<Option<Mat>> {
    let image = imgcodecs::imread(path, imgcodecs::IMREAD_GRAYSCALE)?;
    Ok((!image.empty()).then_some(image))
}
