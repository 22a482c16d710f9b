//! Square black-bordered markers in a grey image: where, and which (S. Garrido-Jurado et al., "Automatic
//! generation and detection of highly reliable fiducial markers under occlusion", Pattern Recognition 2014).
//!
//! Our own, of OpenCV's basic parts: its `aruco` module stands in another library in each of the releases
//! that distributions carry, behind another interface, and brings 330 MB of others along.

use super::Dictionary;
use emberfix_frames::{Matrix3, Vector2, Vector3};
use opencv::core::{Mat, MatTraitConst, Point, Point2f, Size, TermCriteria, Vector};
use opencv::{Result, imgproc};

/// A marker in an image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Marker {
    pub id: usize,
    /// Its upper left corner as printed, and on clockwise; pixels.
    pub corners: [Vector2<f64>; 4],
}

/// Windows of the local threshold, pixels: small markers need small ones, blurred and large ones large.
const THRESHOLD_WINDOWS_PX: [i32; 3] = [7, 15, 41];
/// Darker than the window's mean by this many grey levels is black.
const DARKER_BY: f64 = 7.0;

/// Each of the first `count` markers that is seen, once.
pub(super) fn find_markers(
    image: &Mat,
    dictionary: Dictionary,
    count: usize,
) -> Result<Vec<Marker>> {
    let mut found: Vec<(f64, Marker)> = Vec::new();
    for window in THRESHOLD_WINDOWS_PX {
        for quad in quads(image, window)? {
            let Some(marker) = read(image, &quad, dictionary, count)? else {
                continue;
            };
            let area = area(&marker.corners);
            match found.iter_mut().find(|(_, other)| other.id == marker.id) {
                // The outline of the black border, not that of what is inside.
                Some(known) if known.0 < area => *known = (area, marker),
                Some(_) => {}
                None => found.push((area, marker)),
            }
        }
    }
    let mut markers: Vec<Marker> = found.into_iter().map(|(_, marker)| marker).collect();
    for marker in &mut markers {
        sharpen(image, marker)?;
    }
    Ok(markers)
}

type Quad = [Vector2<f64>; 4];

/// Least side of a marker, pixels: one and a half for each bit.
const LEAST_SIDE_PX: f64 = 9.0;
/// How far an outline may stray from its four sides, as a share of its length.
const STRAY: f64 = 0.04;

/// Outlines with four corners, clockwise.
fn quads(image: &Mat, window_px: i32) -> Result<Vec<Quad>> {
    let mut dark = Mat::default();
    imgproc::adaptive_threshold(
        image,
        &mut dark,
        255.0,
        imgproc::ADAPTIVE_THRESH_MEAN_C,
        imgproc::THRESH_BINARY_INV,
        window_px,
        DARKER_BY,
    )?;
    let mut outlines = Vector::<Vector<Point>>::new();
    imgproc::find_contours_def(
        &dark,
        &mut outlines,
        imgproc::RETR_LIST,
        imgproc::CHAIN_APPROX_NONE,
    )?;
    let mut quads = Vec::new();
    for outline in &outlines {
        if outline.len() as f64 > 4.0 * LEAST_SIDE_PX {
            quads.extend(quad(&outline)?);
        }
    }
    Ok(quads)
}

fn quad(outline: &Vector<Point>) -> Result<Option<Quad>> {
    let mut corners = Vector::<Point>::new();
    let stray = STRAY * imgproc::arc_length(outline, true)?;
    imgproc::approx_poly_dp(outline, &mut corners, stray, true)?;
    if corners.len() != 4 || !imgproc::is_contour_convex(&corners)? {
        return Ok(None);
    }
    let mut quad = [Vector2::zeros(); 4];
    for (to, from) in quad.iter_mut().zip(&corners) {
        *to = Vector2::new(f64::from(from.x), f64::from(from.y));
    }
    if area(&quad) < 0.0 {
        quad.reverse();
    }
    let sides = (0..4).map(|at| (quad[at] - quad[(at + 1) % 4]).norm());
    Ok((sides.fold(f64::INFINITY, f64::min) >= LEAST_SIDE_PX).then_some(quad))
}

/// Twice the area; positive when the corners go clockwise as seen (rows grow downwards).
fn area(quad: &Quad) -> f64 {
    (0..4)
        .map(|at| quad[at].perp(&quad[(at + 1) % 4]))
        .sum::<f64>()
}

/// Difference of black and white that can be read, grey levels.
const LEAST_CONTRAST: f64 = 12.0;
/// Cells of the border that may seem white.
const WHITE_BORDER: usize = 2;

/// Reads the pattern inside a quad.
fn read(image: &Mat, quad: &Quad, dictionary: Dictionary, count: usize) -> Result<Option<Marker>> {
    let side = dictionary.side_bits();
    let Some(cells) = cells(image, quad, side + 2)? else {
        return Ok(None);
    };
    let Some(threshold) = threshold(&cells) else {
        return Ok(None);
    };
    let (mut pattern, mut white_border) = (Vec::with_capacity(side * side), 0);
    for (at, grey) in cells.iter().enumerate() {
        let (row, column, white) = (at / (side + 2), at % (side + 2), *grey > threshold);
        if (1..=side).contains(&row) && (1..=side).contains(&column) {
            pattern.push(white);
        } else {
            white_border += usize::from(white);
        }
    }
    if white_border > WHITE_BORDER {
        return Ok(None);
    }
    Ok(dictionary
        .identify(&pattern, count)
        .map(|(id, turns)| Marker {
            id,
            corners: std::array::from_fn(|at| quad[(at + 4 - turns) % 4]),
        }))
}

/// Mean grey of each of `across` times `across` cells, row by row; `None` where a part lies outside.
fn cells(image: &Mat, quad: &Quad, across: usize) -> Result<Option<Vec<f64>>> {
    let unit = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Vector2::new(x, y));
    let to_image = homography(&unit, quad)?;
    let mut greys = Vec::with_capacity(across * across);
    for at in 0..across * across {
        let mut sum = 0.0;
        for sample in 0..9 {
            let place = |cell: usize, sample: usize| {
                (cell as f64 + 0.3 + 0.2 * sample as f64) / across as f64
            };
            let (x, y) = (
                place(at % across, sample % 3),
                place(at / across, sample / 3),
            );
            match grey_at(image, through(&to_image, Vector2::new(x, y))) {
                Some(grey) => sum += grey,
                None => return Ok(None),
            }
        }
        greys.push(sum / 9.0);
    }
    Ok(Some(greys))
}

fn grey_at(image: &Mat, place: Vector2<f64>) -> Option<f64> {
    let (column, row) = (place.x.round() as i32, place.y.round() as i32);
    let inside = (0..image.cols()).contains(&column) && (0..image.rows()).contains(&row);
    inside
        .then(|| image.at_2d::<u8>(row, column).ok().copied())
        .flatten()
        .map(f64::from)
}

/// Between dark and bright cells (N. Otsu, 1979); `None` where they hardly differ.
fn threshold(cells: &[f64]) -> Option<f64> {
    let mut sorted = cells.to_vec();
    sorted.sort_by(f64::total_cmp);
    let total: f64 = sorted.iter().sum();
    let (mut best, mut below) = ((0.0, 0.0), 0.0);
    for at in 1..sorted.len() {
        below += sorted[at - 1];
        let (dark, bright) = (at as f64, (sorted.len() - at) as f64);
        let apart = (total - below) / bright - below / dark;
        let between = dark * bright * apart * apart;
        if between > best.0 && apart > LEAST_CONTRAST {
            best = (between, 0.5 * (sorted[at - 1] + sorted[at]));
        }
    }
    (best.0 > 0.0).then_some(best.1)
}

/// Moves a marker's corners to where the image's gradients point.
fn sharpen(image: &Mat, marker: &mut Marker) -> Result<()> {
    let mut points: Vector<Point2f> = marker.corners.iter().map(point).collect();
    let side = (marker.corners[0] - marker.corners[1]).norm();
    let half = (0.06 * side).clamp(1.0, 5.0) as i32;
    imgproc::corner_sub_pix(
        image,
        &mut points,
        Size::new(half, half),
        Size::new(-1, -1),
        TermCriteria::new(3, 30, 0.01)?,
    )?;
    for (corner, sharp) in marker.corners.iter_mut().zip(&points) {
        let sharp = Vector2::new(f64::from(sharp.x), f64::from(sharp.y));
        if (sharp - *corner).norm() <= f64::from(half) + 1.0 {
            *corner = sharp;
        }
    }
    Ok(())
}

pub(super) fn point(place: &Vector2<f64>) -> Point2f {
    Point2f::new(place.x as f32, place.y as f32)
}

/// Takes four places to four others.
pub(super) fn homography(from: &Quad, to: &Quad) -> Result<Matrix3<f64>> {
    let points = |quad: &Quad| quad.iter().map(point).collect::<Vector<Point2f>>();
    let found = imgproc::get_perspective_transform_def(&points(from), &points(to))?;
    use opencv::core::MatTraitConstManual;
    Ok(Matrix3::from_row_slice(found.data_typed::<f64>()?))
}

pub(super) fn through(homography: &Matrix3<f64>, place: Vector2<f64>) -> Vector2<f64> {
    let seen = homography * Vector3::new(place.x, place.y, 1.0);
    seen.xy() / seen.z
}
