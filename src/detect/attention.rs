//! Which views of an image are worth a frame's time.
//!
//! The whole frame is always looked at. Each tile's claim to be looked at grows with every frame that
//! passes it over, and the faster, the more a tile can show that the whole frame does not: where a fire of
//! one metre would be too small in the whole frame, and where something was found last time. So the
//! tiles at the far ground come first and often, those of the sky seldom, and none never.

use super::preprocess::View;
use std::ops::Range;

/// A flame of fewer pixels at the network's input is not seen.
const SEEN_PX: f64 = 10.0;

/// How fast a tile's claim grows: where the whole frame would not show a fire of one metre, where nobody
/// knows, where it would, and where no ground is.
const FAR: f64 = 4.0;
const UNKNOWN: f64 = 2.0;
const NEAR: f64 = 1.0;
const SKY: f64 = 0.25;
/// Times that, where something was found last time: what is tracked should stay in sight.
const HELD: f64 = 3.0;

/// How large things on the ground appear over the left image.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundScale {
    columns: usize,
    rows: usize,
    image: (f64, f64),
    /// Raw pixels a metre in the middle of each cell, row-major; `None` where no ground is seen.
    px_per_m: Vec<Option<f64>>,
}

impl GroundScale {
    /// Cells across and down.
    const GRID: (usize, usize) = (8, 6);

    /// Asks for the scale at the middle of each cell of a grid over an image of this size: column and
    /// row, raw pixels.
    pub fn sampled(
        (width, height): (u32, u32),
        mut px_per_m: impl FnMut(f64, f64) -> Option<f64>,
    ) -> Self {
        let (columns, rows) = Self::GRID;
        let image = (f64::from(width), f64::from(height));
        let middle = |index: usize, count: usize, length: f64| {
            (index as f64 + 0.5) / count as f64 * length - 0.5
        };
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
        Self {
            columns,
            rows,
            image,
            px_per_m: cells
                .map(|(column, row)| {
                    px_per_m(middle(column, columns, image.0), middle(row, rows, image.1))
                })
                .collect(),
        }
    }

    /// The scale of the ground about a place (column, row), raw pixels; `None` where none is seen.
    #[must_use]
    pub fn px_per_m(&self, (column, row): (f64, f64)) -> Option<f64> {
        let cell = |at: f64, length: f64, count: usize| {
            ((at / length * count as f64).max(0.0) as usize).min(count - 1)
        };
        let (across, down) = (
            cell(column, self.image.0, self.columns),
            cell(row, self.image.1, self.rows),
        );
        self.px_per_m.get(down * self.columns + across).copied()?
    }

    /// The smallest scale of the ground in a part of the image, raw pixels; `None` where none is seen.
    fn least_in(&self, across: &Range<f64>, down: &Range<f64>) -> Option<f64> {
        let cells = |range: &Range<f64>, count: usize, length: f64| {
            let cell = |edge: f64| (edge / length * count as f64).clamp(0.0, count as f64);
            cell(range.start) as usize..(cell(range.end).ceil() as usize)
        };
        let columns = cells(across, self.columns, self.image.0);
        cells(down, self.rows, self.image.1)
            .flat_map(|row| {
                columns
                    .clone()
                    .map(move |column| row * self.columns + column)
            })
            .filter_map(|cell| self.px_per_m.get(cell).copied().flatten())
            .reduce(f64::min)
    }
}

/// Which views of an image were looked at: of the places in the others a frame says nothing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Looked {
    views: Vec<(View, bool)>,
}

impl Looked {
    /// These of all views; nothing to remember where it was all of them.
    pub(super) fn at(views: &[View], chosen: &[usize]) -> Self {
        if chosen.len() == views.len() {
            return Self::default();
        }
        let looked = |(index, view): (usize, &View)| (*view, chosen.contains(&index));
        Self {
            views: views.iter().enumerate().map(looked).collect(),
        }
    }

    /// Whether a thing of this many raw pixels would have been noticed at a place (column, row): it
    /// was looked at as finely as it ever is, or finely enough for one so large.
    #[must_use]
    pub fn would_show(&self, (column, row): (f64, f64), size_px: f64) -> bool {
        let finest = |only_looked: bool| {
            let here = self.views.iter().filter(|(view, looked)| {
                let (across, down) = view.extent();
                (*looked || !only_looked) && across.contains(&column) && down.contains(&row)
            });
            here.map(|(view, _)| view.scale()).fold(0.0, f64::max)
        };
        let looked = finest(true);
        looked >= finest(false) || looked * size_px >= SEEN_PX
    }
}

/// What each view has waited for.
#[derive(Debug, Default)]
pub(super) struct Attention {
    claims: Vec<f64>,
    held: Vec<bool>,
}

impl Attention {
    /// For so many views, the whole frame first.
    pub fn new(views: usize) -> Self {
        Self {
            claims: vec![0.0; views],
            held: vec![false; views],
        }
    }

    /// The views to look at now, at most so many and at least the whole frame.
    pub fn choose(
        &mut self,
        views: &[View],
        ground: Option<&GroundScale>,
        most: Option<usize>,
    ) -> Vec<usize> {
        let tiles = most.map_or(views.len(), |most| most.max(1)) - 1;
        if tiles + 1 >= views.len() {
            return (0..views.len()).collect();
        }
        let whole = views[0].scale();
        for (index, view) in views.iter().enumerate().skip(1) {
            let held = if self.held[index] { HELD } else { 1.0 };
            self.claims[index] += held * weight(view, whole, ground);
        }
        let mut by_claim: Vec<usize> = (1..views.len()).collect();
        by_claim.sort_by(|a, b| self.claims[*b].total_cmp(&self.claims[*a]));
        by_claim.truncate(tiles);
        by_claim.iter().for_each(|index| self.claims[*index] = 0.0);
        by_claim.insert(0, 0);
        by_claim
    }

    /// Whether a view that was looked at showed anything.
    pub fn note(&mut self, view: usize, found: bool) {
        if let Some(held) = self.held.get_mut(view) {
            *held = found;
        }
    }
}

fn weight(view: &View, whole_scale: f64, ground: Option<&GroundScale>) -> f64 {
    let Some(ground) = ground else {
        return UNKNOWN;
    };
    let (across, down) = view.extent();
    match ground.least_in(&across, &down) {
        None => SKY,
        Some(px_per_m) if px_per_m * whole_scale < SEEN_PX => FAR,
        Some(_) => NEAR,
    }
}

#[cfg(test)]
mod tests {
    use super::super::family::InputSize;
    use super::super::preprocess::plan;
    use super::*;

    const INPUT: InputSize = InputSize {
        width: 416,
        height: 416,
    };

    /// Sky above row 180, far ground to row 400, near ground below it.
    fn ground() -> GroundScale {
        GroundScale::sampled((1280, 720), |_, row| match row {
            ..180.0 => None,
            180.0..400.0 => Some(12.0),
            _ => Some(60.0),
        })
    }

    /// How often each view is looked at in so many frames.
    fn looks(frames: usize, most: usize, ground: Option<&GroundScale>) -> Vec<usize> {
        let views = plan((1280, 720), INPUT, Some(320), 40);
        let mut attention = Attention::new(views.len());
        let mut looks = vec![0; views.len()];
        for _ in 0..frames {
            let chosen = attention.choose(&views, ground, Some(most));
            assert_eq!((chosen.len(), chosen[0]), (most, 0));
            chosen.into_iter().for_each(|view| looks[view] += 1);
        }
        looks
    }

    #[test]
    fn far_ground_is_looked_at_most_and_nothing_never() {
        let looks = looks(120, 4, Some(&ground()));
        // Three rows of five tiles: rows 0 to 320, 200 to 520, 400 to 720.
        let (upper, middle, lower) = (&looks[1..6], &looks[6..11], &looks[11..]);
        assert!(
            upper.iter().chain(middle).all(|n| *n > 2 * lower[0]),
            "{looks:?}"
        );
        assert!(lower.iter().all(|n| *n > 0), "{looks:?}");
        assert_eq!(looks[0], 120);
    }

    #[test]
    fn without_knowledge_of_the_ground_all_tiles_take_turns() {
        let looks = looks(75, 4, None);
        assert!(looks[1..].iter().all(|n| *n == 15), "{looks:?}");
    }

    #[test]
    fn what_was_found_is_looked_for_again_soon() {
        let views = plan((1280, 720), INPUT, Some(320), 40);
        let mut attention = Attention::new(views.len());
        attention.note(9, true);
        let frames = (0..30).map(|_| attention.choose(&views, None, Some(3)));
        let seen = frames.filter(|chosen| chosen.contains(&9)).count();
        assert!(seen >= 8, "{seen}");
    }

    #[test]
    fn what_no_tile_showed_is_not_missed_but_what_the_whole_frame_shows_is() {
        let views = plan((1280, 720), INPUT, Some(416), 96);
        // The whole frame at 0.325 and the tile in the upper left corner.
        let looked = Looked::at(&views, &[0, 1]);
        let (near, far) = ((100.0, 100.0), (1200.0, 700.0));
        assert!(looked.would_show(near, 12.0));
        assert!(!looked.would_show(far, 12.0), "4 px in the whole frame");
        assert!(looked.would_show(far, 40.0), "13 px in the whole frame");
        let all: Vec<usize> = (0..views.len()).collect();
        assert!(Looked::at(&views, &all).would_show(far, 12.0));
        let whole = plan((1280, 720), INPUT, None, 0);
        assert!(Looked::at(&whole, &[0]).would_show(far, 2.0), "never finer");
    }

    #[test]
    fn without_a_limit_everything_is_looked_at() {
        let views = plan((1280, 720), INPUT, Some(416), 96);
        let all = Attention::new(views.len()).choose(&views, None, None);
        assert_eq!(all, (0..9).collect::<Vec<_>>());
    }
}
