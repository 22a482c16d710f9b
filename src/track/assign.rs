//! Which sighting is which fire: the assignment of least total cost.
//!
//! Source: shortest augmenting paths with column prices, Jonker and Volgenant, "A shortest augmenting
//! path algorithm for dense and sparse linear assignment problems" (Computing 38, 1987), the sparse
//! form. Every row may also stay alone at a price, so there is always an answer; each search ends
//! at the nearest free column, so its cost follows the crowd about a sighting, not all fires.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// One way to match a row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// Column.
    pub column: usize,
    /// What the match costs.
    pub cost: f64,
}

/// For each row its column, or `None`: the matching of least total cost, where a row that stays
/// alone costs `alone`. Columns are used at most once.
#[must_use]
pub fn assign(rows: &[Vec<Candidate>], columns: usize, alone: f64) -> Vec<Option<usize>> {
    let mut search = Search::new(rows, columns, alone);
    for row in 0..rows.len() {
        search.augment(row);
    }
    let real = |column: &Option<usize>| column.filter(|column| *column < columns);
    search.column_of.iter().map(real).collect()
}

struct Search<'a> {
    rows: &'a [Vec<Candidate>],
    columns: usize,
    alone: f64,
    price: Vec<f64>,
    row_of: Vec<Option<usize>>,
    column_of: Vec<Option<usize>>,
    /// Of the present search: distance, row that it was reached from, whether it is settled.
    distance: Vec<f64>,
    reached_from: Vec<usize>,
    is_settled: Vec<bool>,
    touched: Vec<usize>,
}

/// A column at a distance; the heap gives the nearest first.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Reach {
    distance: f64,
    column: usize,
}

impl Eq for Reach {}

impl PartialOrd for Reach {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Reach {
    fn cmp(&self, other: &Self) -> Ordering {
        let nearer = other.distance.total_cmp(&self.distance);
        nearer.then(other.column.cmp(&self.column))
    }
}

impl<'a> Search<'a> {
    fn new(rows: &'a [Vec<Candidate>], columns: usize, alone: f64) -> Self {
        // Each row has a column of its own behind the real ones: being alone.
        let all = columns + rows.len();
        Self {
            rows,
            columns,
            alone,
            price: vec![0.0; all],
            row_of: vec![None; all],
            column_of: vec![None; rows.len()],
            distance: vec![f64::INFINITY; all],
            reached_from: vec![0; all],
            is_settled: vec![false; all],
            touched: Vec::new(),
        }
    }

    /// Matches one more row along the shortest path to a free column.
    fn augment(&mut self, start: usize) {
        let mut heap = BinaryHeap::new();
        self.relax(start, 0.0, &mut heap);
        while let Some(Reach { distance, column }) = heap.pop() {
            if self.is_settled[column] {
                continue;
            }
            self.is_settled[column] = true;
            let Some(row) = self.row_of[column] else {
                self.reprice(distance);
                self.flip(start, column);
                break;
            };
            self.relax(row, distance - self.reduced(row, column), &mut heap);
        }
        for column in self.touched.drain(..) {
            self.distance[column] = f64::INFINITY;
            self.is_settled[column] = false;
        }
    }

    fn relax(&mut self, row: usize, base: f64, heap: &mut BinaryHeap<Reach>) {
        let own = Candidate {
            column: self.columns + row,
            cost: self.alone,
        };
        let rows = self.rows;
        for candidate in rows[row].iter().chain(std::iter::once(&own)) {
            let column = candidate.column;
            let distance = base + candidate.cost - self.price[column];
            if !self.is_settled[column] && distance < self.distance[column] {
                self.touched.push(column);
                self.distance[column] = distance;
                self.reached_from[column] = row;
                heap.push(Reach { distance, column });
            }
        }
    }

    /// Cost of a match less the column's price.
    fn reduced(&self, row: usize, column: usize) -> f64 {
        let of = |candidate: &&Candidate| candidate.column == column;
        let cost = self.rows[row]
            .iter()
            .find(of)
            .map_or(self.alone, |c| c.cost);
        cost - self.price[column]
    }

    fn reprice(&mut self, nearest: f64) {
        for column in &self.touched {
            if self.is_settled[*column] {
                let short = (self.distance[*column] - nearest).min(0.0);
                self.price[*column] += short;
                // A column may have been touched twice: it is priced once.
                self.distance[*column] = nearest;
            }
        }
    }

    fn flip(&mut self, start: usize, free: usize) {
        let mut column = free;
        loop {
            let row = self.reached_from[column];
            self.row_of[column] = Some(row);
            let before = self.column_of[row].replace(column);
            match before {
                Some(before) if row != start => column = before,
                _ => return,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn cost(rows: &[Vec<Candidate>], columns: &[Option<usize>], alone: f64) -> f64 {
        let of = |(row, column): (&Vec<Candidate>, &Option<usize>)| {
            column.map_or(alone, |column| {
                row.iter().find(|c| c.column == column).unwrap().cost
            })
        };
        rows.iter().zip(columns).map(of).sum()
    }

    fn best(rows: &[Vec<Candidate>], taken: &mut Vec<usize>, alone: f64) -> f64 {
        let Some((first, rest)) = rows.split_first() else {
            return 0.0;
        };
        let mut least = alone + best(rest, taken, alone);
        for candidate in first {
            if !taken.contains(&candidate.column) {
                taken.push(candidate.column);
                least = least.min(candidate.cost + best(rest, taken, alone));
                taken.pop();
            }
        }
        least
    }

    #[test]
    fn it_is_as_good_as_trying_everything() {
        let mut dice = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..500 {
            let columns = dice.random_range(1..6);
            let rows: Vec<Vec<Candidate>> = (0..dice.random_range(1..6))
                .map(|_| {
                    let some = (0..columns)
                        .filter(|_| dice.random_bool(0.6))
                        .collect::<Vec<_>>();
                    some.into_iter()
                        .map(|column| Candidate {
                            column,
                            cost: dice.random_range(0.0..20.0),
                        })
                        .collect()
                })
                .collect();
            let found = assign(&rows, columns, 12.0);
            let mut used: Vec<_> = found.iter().flatten().collect();
            used.sort_unstable();
            assert!(used.windows(2).all(|pair| pair[0] != pair[1]), "{found:?}");
            let least = best(&rows, &mut Vec::new(), 12.0);
            assert!(
                (cost(&rows, &found, 12.0) - least).abs() < 1e-9,
                "{rows:?} {found:?}"
            );
        }
    }

    #[test]
    fn two_close_fires_shifted_together_keep_their_names() {
        // Both sightings lie one step to the right: the first upon the second fire.
        let squared = |d: f64| d * d;
        let row = |at: f64| {
            [0.0, 3.0]
                .iter()
                .enumerate()
                .map(|(column, fire)| Candidate {
                    column,
                    cost: squared(at - fire),
                })
                .collect::<Vec<_>>()
        };
        let found = assign(&[row(3.0), row(6.0)], 2, 40.0);
        assert_eq!(found, [Some(0), Some(1)]);
    }
}
