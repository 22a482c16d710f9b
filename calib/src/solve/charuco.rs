//! The corners of a ChArUco board that is seen in part or whole: its markers say which they are, the
//! chessboard between them where.

use super::aruco::{Marker, find_markers, homography, point, through};
use super::{Board, Corner, Markers};
use crate::RawPixel;
use emberfix_frames::Vector2;
use opencv::core::{Mat, Point2f, Size, TermCriteria, Vector};
use opencv::prelude::{MatTraitConst, MatTraitConstManual};
use opencv::{Result, calib3d, imgproc};
use std::collections::BTreeMap;

/// Fewest corners of a board that count as a look at it.
const FEWEST_CORNERS: usize = 8;

/// The corners that are seen; `None` where too few are. Markers are read in a version of the image with more
/// contrast, corners placed in the image itself.
pub(super) fn find(
    contrasted: &Mat,
    image: &Mat,
    board: &Board,
    markers: Markers,
) -> Result<Option<Vec<Corner>>> {
    let count = (board.columns + 1) * (board.rows + 1) / 2;
    let seen = find_markers(contrasted, markers.dictionary, count)?;
    let Some(placed) = place(board, markers, &seen)? else {
        return Ok(None);
    };
    let foretold = foretell(board, markers, &placed)?;
    let corners = refine(image, foretold)?;
    Ok(spread_out(board, &corners).then_some(corners))
}

/// Enough corners, and not all on one line.
fn spread_out(board: &Board, corners: &[Corner]) -> bool {
    let several = |of: fn(usize, usize) -> usize| {
        let first = corners.first().map(|corner| of(corner.id, board.columns));
        corners
            .iter()
            .any(|corner| Some(of(corner.id, board.columns)) != first)
    };
    corners.len() >= FEWEST_CORNERS
        && several(|id, columns| id / columns)
        && several(|id, columns| id % columns)
}

/// A marker, and which square it stands in: column, row.
struct Placed {
    marker: Marker,
    square: (usize, usize),
}

/// Which squares are white, and so hold markers: printers differ.
#[derive(Clone, Copy)]
enum Layout {
    /// The upper left square is black (OpenCV from 4.6 on).
    BlackFirst,
    /// The upper left square is white (OpenCV before, with an even number of rows).
    WhiteFirst,
}

impl Layout {
    fn square_of(self, board: &Board, id: usize) -> Option<(usize, usize)> {
        let columns = board.columns + 1;
        let odd = match self {
            Self::BlackFirst => 1,
            Self::WhiteFirst => 0,
        };
        let squares = (0..columns * (board.rows + 1)).map(|at| (at % columns, at / columns));
        squares
            .filter(|(column, row)| (column + row) % 2 == odd)
            .nth(id)
    }
}

/// How far a marker may lie from where the others say it is, squares: a lens bends the board that much.
const ASTRAY: f64 = 0.35;

/// The markers that agree on where the board is, in the layout in which more of them do.
fn place(board: &Board, markers: Markers, seen: &[Marker]) -> Result<Option<Vec<Placed>>> {
    let mut best: Option<Vec<Placed>> = None;
    for layout in [Layout::BlackFirst, Layout::WhiteFirst] {
        let placed = agreeing(board, markers, seen, layout)?;
        if best.as_ref().is_none_or(|best| best.len() < placed.len()) {
            best = Some(placed);
        }
    }
    Ok(best.filter(|placed| placed.len() >= 2))
}

fn agreeing(
    board: &Board,
    markers: Markers,
    seen: &[Marker],
    layout: Layout,
) -> Result<Vec<Placed>> {
    let mut placed: Vec<Placed> = seen
        .iter()
        .filter_map(|marker| {
            let square = layout.square_of(board, marker.id)?;
            Some(Placed {
                marker: *marker,
                square,
            })
        })
        .collect();
    if placed.len() < 2 {
        return Ok(Vec::new());
    }
    let mut on_board = Vector::<Point2f>::new();
    let mut in_image = Vector::<Point2f>::new();
    let (mut side_px, mut sides) = (0.0, 0.0);
    for Placed { marker, square } in &placed {
        for (corner, place) in corners_of(markers, board, *square).iter().enumerate() {
            on_board.push(point(place));
            in_image.push(point(&marker.corners[corner]));
            side_px += (marker.corners[corner] - marker.corners[(corner + 1) % 4]).norm();
            sides += 1.0;
        }
    }
    let square_px = side_px / sides * board.square_m / markers.side_m;
    let mut inliers = Mat::default();
    let limit = ASTRAY * square_px;
    calib3d::find_homography(&on_board, &in_image, &mut inliers, calib3d::RANSAC, limit)?;
    let inliers = inliers.data_typed::<u8>().unwrap_or_default().to_vec();
    let mut at = 0;
    placed.retain(|_| {
        at += 4;
        inliers
            .get(at - 4..at)
            .is_some_and(|four| four.iter().all(|inlier| *inlier != 0))
    });
    Ok(placed)
}

/// A marker's corners in squares from the board's upper left corner, as its own go round.
fn corners_of(markers: Markers, board: &Board, (column, row): (usize, usize)) -> [Vector2<f64>; 4] {
    let gap = 0.5 * (1.0 - markers.side_m / board.square_m);
    let (left, top) = (column as f64 + gap, row as f64 + gap);
    let (right, bottom) = (column as f64 + 1.0 - gap, row as f64 + 1.0 - gap);
    [
        Vector2::new(left, top),
        Vector2::new(right, top),
        Vector2::new(right, bottom),
        Vector2::new(left, bottom),
    ]
}

/// A corner as its markers foretell it.
struct Foretold {
    pixel: Vector2<f64>,
    /// From the corner to the nearest edge of a marker, pixels.
    gap_px: f64,
}

/// Two markers beside a corner must agree to this share of a square.
const AGREEMENT: f64 = 0.25;

/// Each inner corner that has a marker beside it, through that marker's own perspective: a lens hardly
/// bends so little.
fn foretell(
    board: &Board,
    markers: Markers,
    placed: &[Placed],
) -> Result<BTreeMap<usize, Foretold>> {
    let mut by_corner: BTreeMap<usize, Vec<(Vector2<f64>, f64)>> = BTreeMap::new();
    for Placed { marker, square } in placed {
        let to_image = homography(&corners_of(markers, board, *square), &marker.corners)?;
        let square_px = side_px(marker) * board.square_m / markers.side_m;
        for (column, row) in corners_beside(board, *square) {
            let place = Vector2::new(column as f64 + 1.0, row as f64 + 1.0);
            let seen = (through(&to_image, place), square_px);
            by_corner
                .entry(row * board.columns + column)
                .or_default()
                .push(seen);
        }
    }
    let gap = 0.5 * (1.0 - markers.side_m / board.square_m);
    let foretold = by_corner.into_iter().filter_map(|(id, seen)| {
        let (first, square_px) = *seen.first()?;
        let sum: Vector2<f64> = seen.iter().map(|(pixel, _)| *pixel).sum();
        let agree = seen
            .iter()
            .all(|(pixel, _)| (pixel - first).norm() < AGREEMENT * square_px);
        agree.then(|| {
            let pixel = sum / seen.len() as f64;
            let gap_px = gap * square_px;
            (id, Foretold { pixel, gap_px })
        })
    });
    Ok(foretold.collect())
}

/// Least side, pixels.
fn side_px(marker: &Marker) -> f64 {
    let sides = (0..4).map(|at| (marker.corners[at] - marker.corners[(at + 1) % 4]).norm());
    sides.fold(f64::INFINITY, f64::min)
}

/// The inner corners of a square: column, row.
fn corners_beside(
    board: &Board,
    (column, row): (usize, usize),
) -> impl Iterator<Item = (usize, usize)> {
    let (columns, rows) = (board.columns, board.rows);
    let beside = [(1, 1), (0, 1), (1, 0), (0, 0)].into_iter();
    beside.filter_map(move |(left, up)| {
        let (column, row) = (column.checked_sub(left)?, row.checked_sub(up)?);
        (column < columns && row < rows).then_some((column, row))
    })
}

/// Share of the gap that the refining window's half reaches: more takes in a marker's edge.
const WINDOW_SHARE: f64 = 0.9;

/// Moves each corner to where the gradients point, in a window that no marker reaches into; those that
/// run away were none.
fn refine(image: &Mat, foretold: BTreeMap<usize, Foretold>) -> Result<Vec<Corner>> {
    let size = image.size()?;
    let mut corners = Vec::with_capacity(foretold.len());
    for (id, corner) in foretold {
        let half = (WINDOW_SHARE * corner.gap_px).clamp(2.0, 11.0) as i32;
        let margin = f64::from(half) + 1.0;
        let inside = |at: f64, length: i32| (margin..f64::from(length) - margin).contains(&at);
        if !inside(corner.pixel.x, size.width) || !inside(corner.pixel.y, size.height) {
            continue;
        }
        let mut points = Vector::from_slice(&[point(&corner.pixel)]);
        imgproc::corner_sub_pix(
            image,
            &mut points,
            Size::new(half, half),
            Size::new(-1, -1),
            TermCriteria::new(3, 60, 1e-4)?,
        )?;
        let found = points.get(0)?;
        let found = Vector2::new(f64::from(found.x), f64::from(found.y));
        if (found - corner.pixel).norm() < f64::from(half) {
            let pixel = RawPixel {
                u: found.x,
                v: found.y,
            };
            corners.push(Corner { id, pixel });
        }
    }
    Ok(corners)
}
