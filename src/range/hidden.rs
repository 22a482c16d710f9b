//! What a branch hides of a flame, and shows instead.
//!
//! A branch before a flame is dark and sharp, the flame bright and soft: whatever compares grey levels would
//! follow the branch, which is nearer. In the left eye it is known by being thin, dark and between flame: a gap
//! in a row or a column of the flame's pixels that is too dark for ground to be seen through it. What it hides,
//! and a little around, does not count.
//!
//! Ground has dark spots of its own, and flames have gaps: of what gaps show, ground alone is seldom as dark as its
//! own darkest quarter, for flame shines before it. Only where a good share is that dark, something hides.

use super::patch::Area;
use super::scene::Mask;

/// Longest gap, as a share of the target's width, and at least so many pixels: branches are thinner than
/// flames.
const LONGEST_SHARE: f64 = 0.22;
const LONGEST_LEAST_PX: usize = 3;
/// Beside a branch its blurred edge and what it does to a pixel's neighbourhood, pixels.
const AROUND_PX: usize = 2;
/// A smaller share of the flame than this is chance: single dark pixels.
const LEAST_SHARE: f64 = 0.01;
/// Least share of what thin gaps show that is dark: by branches mostly 0.2 to 0.65, through gaps of flames that
/// nothing hides 0.01 to 0.1 (tuning set of `emberfix eval range`; nine branches in ten and one whole flame in
/// thirty pass).
const LEAST_DARK: f64 = 0.12;
/// What hides is no larger than so many times the flame: branches, with what is around them, seldom exceed twice. More
/// is a texture of bright and dark grains.
const MOST_SHARE: f64 = 5.0;
/// A branch goes on beside the flame: so far, pixels.
const BESIDE_PX: usize = 5;

/// What is hidden of a flame by what is thin and as dark as `dark` or darker, grown by what lies beside it;
/// `None` where hardly anything is. Flame and `shines` are of the same pixels.
pub(super) fn hidden(flame: &Mask, shines: &[i16], dark: i16, target: &Area) -> Option<Mask> {
    let (width, height) = (flame.area.width(), flame.area.height());
    let longest = ((LONGEST_SHARE * target.width() as f64) as usize).max(LONGEST_LEAST_PX);
    let mut found = Mask {
        area: flame.area,
        kept: vec![false; flame.kept.len()],
    };
    let mut seen = Shown::default();
    let rows = (0..height).map(|row| (row * width, 1, width));
    let columns = (0..width).map(|column| (column, width, height));
    for (first, step, count) in rows.chain(columns) {
        let gaps = gaps(&flame.kept, first, step, count);
        for gap in gaps.filter(|gap| gap.count <= longest) {
            let darks = gap.places().filter(|place| shines[*place] <= dark).count();
            seen.all += gap.count;
            seen.dark += darks;
            if darks > 0 {
                gap.places().for_each(|place| found.kept[place] = true);
            }
        }
    }
    let count = found.count();
    let chance = (count as f64) < LEAST_SHARE * flame.count() as f64;
    if count == 0 || chance || (seen.dark as f64) < LEAST_DARK * seen.all as f64 {
        return None;
    }
    beside(&mut found, flame, shines, dark);
    let hidden = found.grown(AROUND_PX);
    (hidden.count() as f64 <= MOST_SHARE * flame.count() as f64).then_some(hidden)
}

/// Pixels that thin gaps show: all, and those that are dark.
#[derive(Default)]
struct Shown {
    all: usize,
    dark: usize,
}

/// Adds what is about the flame and as dark as most of what hides it.
fn beside(found: &mut Mask, flame: &Mask, shines: &[i16], dark: i16) {
    let both = shines.iter().zip(&found.kept);
    let mut darks: Vec<i16> = both
        .filter_map(|(shine, kept)| kept.then_some(*shine))
        .collect();
    let middle = darks.len() / 2;
    let as_dark = dark.min(*darks.select_nth_unstable(middle).1);
    let near = flame.grown(BESIDE_PX).kept;
    for ((kept, shine), near) in found.kept.iter_mut().zip(shines).zip(near) {
        *kept |= near && *shine <= as_dark;
    }
}

/// Pixels between two of the flame, in a row or a column: the first, the step to the next, how many.
struct Gap {
    first: usize,
    step: usize,
    count: usize,
}

impl Gap {
    fn places(&self) -> impl Iterator<Item = usize> + use<> {
        (self.first..).step_by(self.step).take(self.count)
    }
}

/// The gaps of one line of `count` pixels.
fn gaps(flame: &[bool], first: usize, step: usize, count: usize) -> impl Iterator<Item = Gap> {
    let mut last = None;
    (0..count).filter_map(move |k| {
        if !flame[first + k * step] {
            return None;
        }
        let before: usize = last.replace(k)?;
        let count = k - before - 1;
        (count > 0).then_some(Gap {
            first: first + (before + 1) * step,
            step,
            count,
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 40;
    const AREA: Area = Area {
        left: 0,
        top: 0,
        right: SIDE as i32,
        bottom: SIDE as i32,
    };
    const GROUND: i16 = 200;

    /// A flame of 24 by 24 pixels on brighter and darker ground, with a slanted bar of some shine before both.
    fn seen(bar: Option<i16>) -> (Mask, Vec<i16>) {
        let inside = |k: usize| (8..32).contains(&(k % SIDE)) && (8..32).contains(&(k / SIDE));
        let barred = |k: usize| (k % SIDE + k / SIDE / 2).abs_diff(28) < 2;
        let shine = |k: usize| match bar {
            Some(bar) if barred(k) => bar,
            _ if inside(k) => 450,
            _ => GROUND + (k % 7) as i16,
        };
        let shines: Vec<i16> = (0..SIDE * SIDE).map(shine).collect();
        let kept = shines.iter().map(|shine| *shine > 300).collect();
        (Mask { area: AREA, kept }, shines)
    }

    #[test]
    fn a_dark_bar_before_a_flame_is_hidden_with_its_edges_and_the_rest_is_not() {
        let (flame, shines) = seen(Some(50));
        let hidden = hidden(&flame, &shines, GROUND, &AREA).unwrap();
        for (place, shine) in shines
            .iter()
            .enumerate()
            .filter(|(place, _)| flame.grown(2).kept[*place])
        {
            assert!(*shine != 50 || hidden.kept[place], "{place}");
        }
        let kept = flame
            .kept
            .iter()
            .zip(&hidden.kept)
            .filter(|(flame, hidden)| **flame && !**hidden);
        assert!(kept.count() * 2 > flame.count());
    }

    #[test]
    fn ground_that_shows_through_a_flame_and_a_whole_flame_hide_nothing() {
        for bar in [None, Some(GROUND + 1)] {
            let (flame, shines) = seen(bar);
            assert_eq!(hidden(&flame, &shines, GROUND, &AREA), None, "{bar:?}");
        }
    }

    /// Gaps of three pixels in every fourth row; one in sixteen of their pixels is a dark spot of the ground.
    #[test]
    fn dark_spots_of_the_ground_in_gaps_of_a_flame_are_no_branch() {
        let (mut flame, mut shines) = seen(None);
        let gap = |place: &usize| place / SIDE % 4 == 1 && place % 5 < 3;
        for place in (0..SIDE * SIDE).filter(gap) {
            flame.kept[place] = false;
            shines[place] = GROUND + if place % 16 == 0 { 0 } else { 20 };
        }
        assert_eq!(hidden(&flame, &shines, GROUND, &AREA), None);
        for place in (0..SIDE * SIDE).filter(gap) {
            shines[place] = GROUND - i16::from(place % 3 == 0);
        }
        assert!(hidden(&flame, &shines, GROUND, &AREA).is_some());
    }

    #[test]
    fn grains_of_a_texture_hide_nothing() {
        let mut state = 1_u32;
        let mut grain = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as i16
        };
        let shines: Vec<i16> = (0..SIDE * SIDE).map(|_| grain()).collect();
        let kept = shines.iter().map(|shine| *shine > 230).collect();
        let flame = Mask { area: AREA, kept };
        assert_eq!(hidden(&flame, &shines, 64, &AREA), None);
    }

    #[test]
    fn a_dark_gap_that_is_as_wide_as_the_flame_is_no_branch() {
        let (mut flame, mut shines) = seen(None);
        for place in (0..SIDE * SIDE).filter(|place| (14..26).contains(&(place % SIDE))) {
            flame.kept[place] = false;
            shines[place] = 50;
        }
        assert_eq!(hidden(&flame, &shines, GROUND, &AREA), None);
    }
}
