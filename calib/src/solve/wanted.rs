//! Which views of the board a calibration still wants: places in the picture, tilts, distances.
//!
//! Nothing of the camera is known yet, so tilts are judged with a lens as most have it; ten degrees of
//! error do no harm there.

use super::calibration::{COVERAGE_CELLS, cell};
use super::{Board, Corner, View};
use crate::RawPixel;
use emberfix_frames::Vector3;
use opencv::calib3d;
use opencv::core::{Mat, MatTraitConst, Point2f, Point3f, Vector};
use std::collections::BTreeSet;
use std::fmt;

/// How a board was held.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Hold {
    /// Facing the camera.
    Flat,
    /// Its left edge farther away than its right one.
    LeftAway,
    /// Its right edge farther away.
    RightAway,
    /// Its upper edge farther away.
    TopAway,
    /// Its lower edge farther away.
    BottomAway,
}

impl fmt::Display for Hold {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Flat => "facing the cameras",
            Self::LeftAway => "left edge away",
            Self::RightAway => "right edge away",
            Self::TopAway => "upper edge away",
            Self::BottomAway => "lower edge away",
        })
    }
}

/// A third of the picture's width and height.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    row: usize,
    column: usize,
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let row = ["upper", "middle", "lower"][self.row.min(2)];
        let column = ["left", "middle", "right"][self.column.min(2)];
        match (self.row, self.column) {
            (1, 1) => f.write_str("middle"),
            _ => write!(f, "{row} {column}"),
        }
    }
}

/// What one view shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Look {
    place: Place,
    hold: Hold,
    is_near: bool,
}

impl fmt::Display for Look {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let distance = if self.is_near { "near" } else { "far" };
        write!(f, "{}, {}, {distance}", self.place, self.hold)
    }
}

/// Views of each hold.
const OF_EACH_HOLD: usize = 3;
/// Views of each distance.
const OF_EACH_DISTANCE: usize = 4;
/// Views in all that do for most uses.
pub const USUAL_VIEWS: usize = 20;
/// Share of the coverage grid's cells that corners must have fallen into, in each eye.
const COVERED: f64 = 0.75;

/// What was taken so far, and what is missing.
#[derive(Debug, Clone)]
pub struct Wanted {
    board: Board,
    size: (u32, u32),
    in_all: usize,
    looks: Vec<Look>,
    covered: [BTreeSet<usize>; 2],
}

impl Wanted {
    /// Nothing taken yet, of images of this size; `in_all` views are wanted at least
    /// ([`USUAL_VIEWS`]; every fourfold number halves what range is off by).
    #[must_use]
    pub fn new(board: Board, image_size_px: (u32, u32), in_all: usize) -> Self {
        Self {
            board,
            size: image_size_px,
            in_all,
            looks: Vec::new(),
            covered: [BTreeSet::new(), BTreeSet::new()],
        }
    }

    /// Counts a view.
    ///
    /// # Errors
    /// What OpenCV says of its corners.
    pub fn take(&mut self, view: &View) -> opencv::Result<Look> {
        let look = look(&self.board, &view.left, self.size)?;
        self.looks.push(look);
        for (covered, corners) in self.covered.iter_mut().zip([&view.left, &view.right]) {
            let cells = corners
                .iter()
                .filter_map(|corner| cell(corner.pixel, self.size));
            covered.extend(cells);
        }
        Ok(look)
    }

    /// Views taken.
    #[must_use]
    pub fn taken(&self) -> usize {
        self.looks.len()
    }

    /// Whether nothing is missing.
    #[must_use]
    pub fn is_content(&self) -> bool {
        self.missing().is_empty()
    }

    /// What to show next, most wanted first; empty when there is enough of everything.
    #[must_use]
    pub fn missing(&self) -> Vec<String> {
        let mut missing = Vec::new();
        missing.extend(self.missing_holds());
        missing.extend(self.missing_places());
        missing.extend(self.missing_distances());
        if missing.is_empty() && self.taken() < self.in_all {
            missing.push(format!(
                "{} more, each held otherwise",
                self.in_all - self.taken()
            ));
        }
        missing
    }

    fn count(&self, of: impl Fn(&Look) -> bool) -> usize {
        self.looks.iter().filter(|look| of(look)).count()
    }

    fn missing_holds(&self) -> Vec<String> {
        let holds = [
            Hold::LeftAway,
            Hold::RightAway,
            Hold::TopAway,
            Hold::BottomAway,
            Hold::Flat,
        ];
        let short = holds.into_iter().filter_map(|hold| {
            let more = OF_EACH_HOLD.saturating_sub(self.count(|look| look.hold == hold));
            (more > 0).then(|| format!("{hold} ({more} more)"))
        });
        short.collect()
    }

    /// Corners are wanted everywhere in both eyes; told is in which third they are missing.
    fn missing_places(&self) -> Vec<String> {
        let (columns, rows) = COVERAGE_CELLS;
        let mut told = Vec::new();
        for (eye, covered) in ["left", "right"].into_iter().zip(&self.covered) {
            if covered.len() as f64 >= COVERED * (columns * rows) as f64 {
                continue;
            }
            let open: BTreeSet<Place> = (0..columns * rows)
                .filter(|cell| !covered.contains(cell))
                .map(|cell| Place {
                    row: cell / columns * 3 / rows,
                    column: cell % columns * 3 / columns,
                })
                .collect();
            let places: Vec<String> = open.iter().map(ToString::to_string).collect();
            told.push(format!("{} of the {eye} picture", places.join(", ")));
        }
        told
    }

    fn missing_distances(&self) -> Vec<String> {
        let near = self.count(|look| look.is_near);
        let far = self.taken() - near;
        let short = |count: usize, what: &str| {
            let more = OF_EACH_DISTANCE.saturating_sub(count);
            (more > 0).then(|| format!("{what} ({more} more)"))
        };
        [
            short(near, "near, so that it fills half of the picture"),
            short(far, "farther away"),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// Tilts above this are tilts, as the part of the board's normal that does not point at the camera.
const TILTED: f64 = 0.3;
/// Focal length of a lens as most have it, image widths.
const USUAL_FOCAL: f64 = 0.8;
/// A near board's corners span this share of the picture's width or height.
const NEAR_SPAN: f64 = 0.5;

fn look(board: &Board, corners: &[Corner], (width, height): (u32, u32)) -> opencv::Result<Look> {
    let count = corners.len().max(1) as f64;
    let sum = |of: fn(RawPixel) -> f64| corners.iter().map(|corner| of(corner.pixel)).sum::<f64>();
    let (u, v) = (sum(|pixel| pixel.u) / count, sum(|pixel| pixel.v) / count);
    let third = |at: f64, length: u32| (3.0 * at / f64::from(length)).clamp(0.0, 2.0) as usize;
    Ok(Look {
        place: Place {
            row: third(v, height),
            column: third(u, width),
        },
        hold: hold(&normal(board, corners, (width, height))?),
        is_near: is_near(corners, (width, height)),
    })
}

fn is_near(corners: &[Corner], (width, height): (u32, u32)) -> bool {
    let span = |of: fn(RawPixel) -> f64| {
        let (low, high) = corners
            .iter()
            .fold((f64::MAX, f64::MIN), |(low, high), corner| {
                (low.min(of(corner.pixel)), high.max(of(corner.pixel)))
            });
        high - low
    };
    span(|pixel| pixel.u) > NEAR_SPAN * f64::from(width)
        || span(|pixel| pixel.v) > NEAR_SPAN * f64::from(height)
}

/// The board's normal, away from the camera, in camera axes.
fn normal(
    board: &Board,
    corners: &[Corner],
    (width, height): (u32, u32),
) -> opencv::Result<Vector3<f64>> {
    let focal = USUAL_FOCAL * f64::from(width);
    let camera = [
        [focal, 0.0, 0.5 * f64::from(width)],
        [0.0, focal, 0.5 * f64::from(height)],
        [0.0, 0.0, 1.0],
    ];
    let camera = Mat::from_slice_2d(&camera)?;
    let on_board: Vector<Point3f> = corners
        .iter()
        .map(|corner| {
            let place = board.point_m(corner.id);
            Point3f::new(place.x as f32, place.y as f32, 0.0)
        })
        .collect();
    let in_image: Vector<Point2f> = corners
        .iter()
        .map(|corner| Point2f::new(corner.pixel.u as f32, corner.pixel.v as f32))
        .collect();
    let (mut turn, mut origin, mut matrix) = (Mat::default(), Mat::default(), Mat::default());
    calib3d::solve_pnp(
        &on_board,
        &in_image,
        &camera,
        &Mat::default(),
        &mut turn,
        &mut origin,
        false,
        calib3d::SOLVEPNP_IPPE,
    )?;
    calib3d::rodrigues_def(&turn, &mut matrix)?;
    let part = |row: i32| matrix.at_2d::<f64>(row, 2).copied();
    Ok(Vector3::new(part(0)?, part(1)?, part(2)?))
}

/// A normal that points away and to the left means that the board's right edge is farther away.
fn hold(normal: &Vector3<f64>) -> Hold {
    let (x, y) = (normal.x, normal.y);
    if x.hypot(y) < TILTED {
        Hold::Flat
    } else if x.abs() > y.abs() {
        if x < 0.0 {
            Hold::RightAway
        } else {
            Hold::LeftAway
        }
    } else if y < 0.0 {
        Hold::BottomAway
    } else {
        Hold::TopAway
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::UnitQuaternion;

    const SIZE: (u32, u32) = (640, 480);

    /// A board half a metre away through a plain lens, turned by a rotation vector in degrees.
    fn view(turn_deg: [f64; 3], at_m: [f64; 3]) -> View {
        let board = Board::chess(9, 6, 0.028);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from(turn_deg).map(f64::to_radians));
        let corners = (0..board.corners()).map(|id| {
            let point = turn * (board.point_m(id) - board.middle_m()) + Vector3::from(at_m);
            let pixel = RawPixel {
                u: 320.0 + 520.0 * point.x / point.z,
                v: 240.0 + 520.0 * point.y / point.z,
            };
            Corner { id, pixel }
        });
        let corners: Vec<Corner> = corners.collect();
        View {
            name: String::new(),
            left: corners.clone(),
            right: corners,
        }
    }

    #[test]
    fn a_view_is_told_as_a_person_would_tell_it() {
        let mut wanted = Wanted::new(Board::chess(9, 6, 0.028), SIZE, USUAL_VIEWS);
        for (turn_deg, at_m, told) in [
            (
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 0.6],
                "middle, facing the cameras, far",
            ),
            (
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 0.3],
                "middle, facing the cameras, near",
            ),
            // +Y points down: a turn about it brings the right edge towards -Z, nearer.
            (
                [0.0, 35.0, 0.0],
                [-0.25, 0.0, 0.6],
                "middle left, left edge away, far",
            ),
            (
                [0.0, -35.0, 0.0],
                [0.25, 0.0, 0.6],
                "middle right, right edge away, far",
            ),
            (
                [35.0, 0.0, 0.0],
                [0.0, -0.19, 0.6],
                "upper middle, lower edge away, far",
            ),
            (
                [-35.0, 0.0, 0.0],
                [0.0, 0.19, 0.6],
                "lower middle, upper edge away, far",
            ),
        ] {
            // A turn about X by +35 degrees takes the lower edge (+Y) to +Z, away.
            let look = wanted.take(&view(turn_deg, at_m)).unwrap();
            assert_eq!(look.to_string(), told, "{turn_deg:?}");
        }
    }

    #[test]
    fn what_is_missing_shrinks_and_ends() {
        let mut wanted = Wanted::new(Board::chess(9, 6, 0.028), SIZE, USUAL_VIEWS);
        let first = wanted.missing();
        assert!(
            first
                .iter()
                .any(|line| line.contains("left edge away (3 more)")),
            "{first:?}"
        );
        assert!(
            first.iter().any(|line| line.contains("upper left")),
            "{first:?}"
        );
        for row in [-1.0, 0.0, 1.0] {
            for column in [-1.0, 0.0, 1.0] {
                for (turn, far) in [(30.0, 0.6), (-30.0, 0.4)] {
                    let axis = if (row + column) as i32 % 2 == 0 {
                        [turn, 0.0, 0.0]
                    } else {
                        [0.0, turn, 0.0]
                    };
                    let place = [0.31 * far * column * 1.3, 0.28 * far * row, far];
                    wanted.take(&view(axis, place)).unwrap();
                }
            }
        }
        assert!(!wanted.is_content(), "no flat ones yet");
        for at in [0.25, 0.28, 0.32, 0.35] {
            wanted.take(&view([0.0; 3], [0.0, 0.0, at])).unwrap();
        }
        assert!(wanted.is_content(), "{:?}", wanted.missing());
    }
}
