//! Boxes of one frame against each other.

use super::Classified;
use super::grid::Grid;
use crate::locate::{Sighting, View};
use emberfix_calib::Eye;

/// Smoke this close to a fire's pixel, in its own sizes, is that fire's smoke.
const SMOKE_REACH: f64 = 0.6;

/// The sightings of a frame by where they are: those whose boxes may touch are found without looking at all.
pub struct Crowd<'a> {
    /// All of them, as they came.
    pub sightings: &'a [Classified],
    grid: Grid,
    /// Largest box, width and height, pixels.
    largest_px: (f64, f64),
}

impl<'a> Crowd<'a> {
    /// Those of one frame.
    #[must_use]
    pub fn of(sightings: &'a [Classified], view: &View<'_>) -> Self {
        let middles: Vec<_> = sightings.iter().map(|s| middle(&s.sighting)).collect();
        let sizes = sightings.iter().map(|s| s.sighting.size_px);
        Self {
            sightings,
            grid: Grid::new(view.rig.camera(Eye::Left).image_size_px, &middles),
            largest_px: sizes.fold((0.0, 0.0), |(w, h): (f64, f64), size| {
                (w.max(size.0), h.max(size.1))
            }),
        }
    }

    /// Those whose boxes may touch this one's, and some that do not.
    pub fn about(&self, this: &Sighting) -> impl Iterator<Item = usize> {
        let reach = |own: f64, largest: f64| (own + largest) / 2.0;
        let (width, height) = this.size_px;
        let reach = (
            reach(width, self.largest_px.0),
            reach(height, self.largest_px.1),
        );
        self.grid.near(middle(this), reach)
    }
}

/// Middle of its box, column and row.
fn middle(sighting: &Sighting) -> (f64, f64) {
    let base = sighting.base;
    (base.u, base.v - sighting.size_px.1 / 2.0)
}

/// True when `outer` holds most of `inner`.
#[must_use]
pub fn contains(outer: &Sighting, inner: &Sighting) -> bool {
    let overlap = |a: f64, a_len: f64, b: f64, b_len: f64| {
        ((a + a_len / 2.0).min(b + b_len / 2.0) - (a - a_len / 2.0).max(b - b_len / 2.0)).max(0.0)
    };
    let (out, inn) = (middle(outer), middle(inner));
    let shared = overlap(out.0, outer.size_px.0, inn.0, inner.size_px.0)
        * overlap(out.1, outer.size_px.1, inn.1, inner.size_px.1);
    shared > 0.5 * inner.size_px.0 * inner.size_px.1
}

/// Whether a pixel is close enough to smoke for it to be that fire's.
#[must_use]
pub fn is_near_box(sighting: &Sighting, u: f64, v: f64) -> bool {
    let (width, height) = sighting.size_px;
    let (column, row) = middle(sighting);
    (u - column).abs() < (0.5 + SMOKE_REACH) * width + 20.0
        && (v - row).abs() < (0.5 + SMOKE_REACH) * height + 20.0
}
