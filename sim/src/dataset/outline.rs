//! The outline of a set of pixels as one closed line, as YOLO's segment labels want it.

use std::collections::BTreeMap;

/// Corner between pixels: column, row; corner (0, 0) is the upper left one of pixel (0, 0).
pub(super) type Corner = (u32, u32);

/// A closed line that encloses exactly the pixels for which `covers` (column, row) is true, by the rule
/// of odd crossings. Pieces and holes hang together by lines that are gone there and back, which enclose
/// nothing. Empty when nothing is covered.
pub(super) fn outline(columns: u32, rows: u32, covers: impl Fn(u32, u32) -> bool) -> Vec<Corner> {
    let rings = rings(edges(columns, rows, covers));
    let starts: Vec<Corner> = rings.iter().map(|ring| ring[0]).collect();
    let there = rings.into_iter().flat_map(|ring| {
        let first = ring[0];
        ring.into_iter().chain([first])
    });
    // The line closes itself to the first start.
    let back = starts.iter().rev().skip(1);
    let back = back.take(starts.len().saturating_sub(2)).copied();
    there.chain(back).collect()
}

/// From each corner, where the border goes on to: one pixel's side a step, the covered pixel on its right.
type Edges = BTreeMap<Corner, Vec<Corner>>;

fn edges(columns: u32, rows: u32, covers: impl Fn(u32, u32) -> bool) -> Edges {
    let inside = |column: Option<u32>, row: Option<u32>| match (column, row) {
        (Some(x), Some(y)) => x < columns && y < rows && covers(x, y),
        _ => false,
    };
    let mut edges = Edges::new();
    for (y, x) in (0..rows).flat_map(|y| (0..columns).map(move |x| (y, x))) {
        if !covers(x, y) {
            continue;
        }
        let (here, across, below, beyond) = ((x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1));
        for (neighbour, from, to) in [
            ((Some(x), y.checked_sub(1)), here, across),
            ((Some(x + 1), Some(y)), across, beyond),
            ((Some(x), Some(y + 1)), beyond, below),
            ((x.checked_sub(1), Some(y)), below, here),
        ] {
            if !inside(neighbour.0, neighbour.1) {
                edges.entry(from).or_default().push(to);
            }
        }
    }
    edges
}

/// Closed rings, only their corners where they turn. As many sides end at a corner as begin there, so
/// every walk comes back to where it began.
fn rings(mut edges: Edges) -> Vec<Vec<Corner>> {
    let mut rings = Vec::new();
    while let Some((&start, _)) = edges.first_key_value() {
        let mut walked = vec![start];
        let mut at = start;
        while let Some(next) = step(&mut edges, at) {
            at = next;
            if at == start {
                break;
            }
            walked.push(at);
        }
        let turns = |k: usize| {
            let (before, after) = (
                walked[(k + walked.len() - 1) % walked.len()],
                walked[(k + 1) % walked.len()],
            );
            before.0 != after.0 && before.1 != after.1
        };
        rings.push(
            (0..walked.len())
                .filter(|k| turns(*k))
                .map(|k| walked[k])
                .collect(),
        );
    }
    rings
}

fn step(edges: &mut Edges, at: Corner) -> Option<Corner> {
    let ways = edges.get_mut(&at)?;
    let next = ways.pop();
    if ways.is_empty() {
        edges.remove(&at);
    }
    next
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    /// Whether a ray to the left from a pixel's middle crosses the line an odd number of times.
    fn encloses(line: &[Corner], x: u32, y: u32) -> bool {
        let (column, row) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
        let crossed = (0..line.len()).filter(|k| {
            let point = |k: usize| (f64::from(line[k].0), f64::from(line[k].1));
            let (a, b) = (point(*k), point((k + 1) % line.len()));
            let passes = (a.1 > row) != (b.1 > row);
            passes && a.0 + (row - a.1) / (b.1 - a.1) * (b.0 - a.0) < column
        });
        crossed.count() % 2 == 1
    }

    /// Specks that touch at corners, holes and islands in holes among them.
    #[test]
    fn the_line_encloses_the_pixels_and_nothing_else() {
        for (seed, share) in [(1, 0.05), (2, 0.4), (3, 0.6), (4, 0.95)] {
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
            let pixels: Vec<bool> = (0..20 * 13).map(|_| rng.random_bool(share)).collect();
            let covers = |x: u32, y: u32| pixels[(y * 20 + x) as usize];
            let line = outline(20, 13, covers);
            for (x, y) in (0..13).flat_map(|y| (0..20).map(move |x| (x, y))) {
                assert_eq!(encloses(&line, x, y), covers(x, y), "{seed}: {x} {y}");
            }
        }
    }

    #[test]
    fn a_rectangle_has_four_corners_and_nothing_has_none() {
        let line = outline(9, 9, |x, y| (2..5).contains(&x) && (3..8).contains(&y));
        assert_eq!(line, [(2, 3), (5, 3), (5, 8), (2, 8), (2, 3)]);
        assert!(outline(9, 9, |_, _| false).is_empty());
    }
}
