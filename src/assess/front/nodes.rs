//! Which ovals the rows allow: a grid of cells, each solved by weighted least squares and weighed by its
//! evidence.
//!
//! A cell stands for all ovals about its middle: the direction of the head, the length and the width of
//! the flanks are unknowns too, with the cell as their prior. Without that, an oval between two cells fits
//! worse than one that points the other way, since boxes of a large fire are sharper than the grid.

use super::super::extent::Wind;
use super::oval::{CELL, Cell, Oval, cells, round_likely};
use super::scene::{FLAME_SIGMA, GROWTH, HALF_WIDTH_SIGMA, Row, Scene};
use nalgebra::{Cholesky, DMatrix, DVector, SMatrix, SVector};

/// What is solved for at each node: place of ignition from the foot (east, north), distance of the
/// head now, its speed, scale of the flames, its growth, what their half width differs by; and where
/// in its cell the oval is.
pub(super) const UNKNOWNS: usize = 10;
pub(super) const H: usize = 2;
pub(super) const V: usize = 3;
pub(super) const FLAME: usize = 4;
pub(super) const WIDER: usize = 6;
pub(super) const TURN: usize = 7;
pub(super) type Unknowns = SVector<f64, UNKNOWNS>;

/// Columns that are a node's own: over H, over V, and over the place in its cell.
const OWN: usize = 5;
/// Prior of the speed, m/s.
const SPEED_PRIOR: f64 = 3.0;
/// Cells of each direction of the head that are looked at closely.
const CLOSE: usize = 3;
/// Times that the place in a cell is solved for: what it does is not linear.
const TURNS: usize = 2;
/// Step of the differences that say what it does.
const STEP: f64 = 1e-3;

/// One node: an oval, and what follows for it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Node {
    pub oval: Oval,
    pub solved: Unknowns,
    pub covariance: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    /// Log of its likelihood; once weighed, its share of all.
    pub weight: f64,
    /// Squared errors against what was expected of them.
    pub misfit: f64,
}

/// What the rows are wrong by, factored; and the columns that all nodes share, whitened.
struct Doubt {
    lower: DMatrix<f64>,
    seen: DVector<f64>,
    shared: DMatrix<f64>,
    prior: Unknowns,
    prior_mean: Unknowns,
}

/// All nodes that matter, by what each row is worth against what is assumed.
pub(super) fn nodes(scene: &Scene<'_>, worth: f64, wind: Option<&Wind>) -> Option<Vec<Node>> {
    let doubt = Doubt::of(scene, worth)?;
    let rows = &scene.rows;
    let mut nodes = Vec::new();
    if let Some(mut round) = doubt.solve(&doubt.own(rows, &Oval::ROUND)?, Oval::ROUND) {
        round.weight += round_likely().ln();
        nodes.push(round);
    }
    for of_head in cells() {
        let known = |(cell, likely): &(Cell, f64), mut node: Node| {
            node.weight += likely.ln() + node.oval.downwind(wind);
            (*cell, *likely, node)
        };
        let ovals: Vec<Oval> = of_head
            .iter()
            .map(|(cell, _)| cell.moved([0.0; 3]))
            .collect();
        let solved = doubt.solve_all(rows, &ovals)?;
        let mut first: Vec<(Cell, f64, Node)> = of_head
            .iter()
            .zip(solved)
            .filter_map(|(cell, node)| Some(known(cell, node?)))
            .collect();
        first.sort_by(|a, b| b.2.weight.total_cmp(&a.2.weight));
        for (cell, likely, node) in first.into_iter().take(CLOSE) {
            let node = doubt.closely(rows, &cell, node)?;
            nodes.extend(node.map(|node| known(&(cell, likely), node).2));
        }
    }
    Some(nodes)
}

impl Doubt {
    fn of(scene: &Scene<'_>, worth: f64) -> Option<Self> {
        let n = scene.rows.len();
        let lower = Cholesky::new(scene.covariance_of_rows(worth))?.l();
        let seen = DVector::from_iterator(n, scene.rows.iter().map(|row| row.metres));
        let columns: Vec<[f64; 5]> = scene.rows.iter().map(Row::shared_columns).collect();
        let shared = DMatrix::from_fn(n, 5, |i, k| columns[i][k]);
        let (flame, range_m) = (scene.flame_m, scene.sight.norm());
        let [turn, longer, wider] = CELL;
        let sigmas = [
            range_m,
            range_m,
            range_m,
            SPEED_PRIOR,
            FLAME_SIGMA * flame,
            GROWTH * flame,
            HALF_WIDTH_SIGMA * flame,
            turn,
            longer,
            wider,
        ];
        let mut prior_mean = Unknowns::zeros();
        prior_mean[FLAME] = flame;
        Some(Self {
            seen: lower.solve_lower_triangular(&seen)?,
            shared: lower.solve_lower_triangular(&shared)?,
            lower,
            prior: SVector::from(sigmas.map(|sigma: f64| sigma.powi(-2))),
            prior_mean,
        })
    }

    /// The nodes in the middle of cells, as far as there are any.
    fn solve_all(&self, rows: &[Row], ovals: &[Oval]) -> Option<Vec<Option<Node>>> {
        let mut columns = DMatrix::zeros(rows.len(), 2 * ovals.len());
        for (k, oval) in ovals.iter().enumerate() {
            for (i, row) in rows.iter().enumerate() {
                let reach = row.flat * oval.reach(&row.outwards);
                columns[(i, 2 * k)] = reach;
                columns[(i, 2 * k + 1)] = reach * row.t_s;
            }
        }
        let columns = self.lower.solve_lower_triangular(&columns)?;
        let solve = |(k, oval): (usize, &Oval)| {
            let own = columns.columns(2 * k, 2).into_owned();
            self.solve(&own.resize_horizontally(OWN, 0.0), *oval)
        };
        Some(ovals.iter().enumerate().map(solve).collect())
    }

    /// The columns of one oval that stays as it is, whitened.
    fn own(&self, rows: &[Row], oval: &Oval) -> Option<DMatrix<f64>> {
        let reach = |row: &Row| row.flat * oval.reach(&row.outwards);
        let own = DMatrix::from_fn(rows.len(), OWN, |i, k| match k {
            0 => reach(&rows[i]),
            1 => reach(&rows[i]) * rows[i].t_s,
            _ => 0.0,
        });
        self.lower.solve_lower_triangular(&own)
    }

    /// Solves for the place in the cell too. Outer `None`: the rows can't be whitened; inner: no node.
    fn closely(&self, rows: &[Row], cell: &Cell, start: Node) -> Option<Option<Node>> {
        let mut node = start;
        for _ in 0..TURNS {
            let place = node.place();
            let own = self
                .lower
                .solve_lower_triangular(&moving(rows, cell, &node))?;
            // Linear about the place so far: what it does there is on the side of what is seen.
            let shift: DVector<f64> = own.columns(2, 3) * DVector::from_row_slice(&place);
            let seen = &self.seen + shift;
            match self.solve_for(&own, &seen, cell.moved(place)) {
                Some(solved) => node = solved,
                None => return Some(None),
            }
        }
        node.oval = cell.moved(node.place());
        Some(Some(node))
    }

    fn solve(&self, own: &DMatrix<f64>, oval: Oval) -> Option<Node> {
        self.solve_for(own, &self.seen, oval)
    }

    /// The node for one oval, whose own columns are given whitened.
    fn solve_for(&self, own: &DMatrix<f64>, seen: &DVector<f64>, oval: Oval) -> Option<Node> {
        let column = |k: usize| match k {
            0 | 1 => self.shared.column(k),
            H | V => own.column(k - H),
            FLAME..=WIDER => self.shared.column(k - 2),
            _ => own.column(k - TURN + 2),
        };
        let mut information = SMatrix::from_diagonal(&self.prior);
        let mut right = self.prior.component_mul(&self.prior_mean);
        for i in 0..UNKNOWNS {
            right[i] += column(i).dot(seen);
            for j in 0..=i {
                let product = column(i).dot(&column(j));
                information[(i, j)] += product;
                if i != j {
                    information[(j, i)] += product;
                }
            }
        }
        let cholesky = information.cholesky()?;
        let solved: Unknowns = cholesky.solve(&right);
        let log_determinant: f64 = cholesky.l().diagonal().iter().map(|d| 2.0 * d.ln()).sum();
        let expected = self
            .prior
            .dot(&self.prior_mean.component_mul(&self.prior_mean));
        let misfit = seen.norm_squared() + expected - solved.dot(&right);
        let backwards = solved[H] < 0.0 && oval.back < 1.0;
        (!backwards).then(|| Node {
            oval,
            solved,
            covariance: cholesky.inverse(),
            weight: -0.5 * (misfit + log_determinant),
            misfit,
        })
    }
}

impl Node {
    /// Where in its cell the oval is.
    fn place(&self) -> [f64; 3] {
        // Beyond the neighbouring cells it is theirs.
        [0, 1, 2].map(|k: usize| self.solved[TURN + k].clamp(-2.0 * CELL[k], 2.0 * CELL[k]))
    }
}

/// Columns of an oval that may move in its cell, at the distance and the speed of a node.
fn moving(rows: &[Row], cell: &Cell, node: &Node) -> DMatrix<f64> {
    let place = node.place();
    let oval = cell.moved(place);
    let beside = |k: usize, by: f64| {
        let mut place = place;
        place[k] += by;
        cell.moved(place)
    };
    let steps = [0, 1, 2].map(|k: usize| (beside(k, STEP), beside(k, -STEP)));
    DMatrix::from_fn(rows.len(), OWN, |i, k| {
        let row = &rows[i];
        let reach = |oval: &Oval| row.flat * oval.reach(&row.outwards);
        match k {
            0 => reach(&oval),
            1 => reach(&oval) * row.t_s,
            _ => {
                let (more, less) = &steps[k - 2];
                let slope = (reach(more) - reach(less)) / (2.0 * STEP);
                slope * (node.solved[H] + node.solved[V] * row.t_s)
            }
        }
    })
}

/// The same with weights that sum to 1; nodes that don't matter are left out.
pub(super) fn weighed(nodes: Vec<Node>) -> Vec<Node> {
    let best = nodes
        .iter()
        .map(|node| node.weight)
        .fold(f64::MIN, f64::max);
    let weights: Vec<f64> = nodes
        .iter()
        .map(|node| (node.weight - best).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    let nodes = nodes.into_iter().zip(weights).map(|(node, weight)| Node {
        weight: weight / total,
        ..node
    });
    nodes.filter(|node| node.weight > 1e-6).collect()
}
