//! How a fire lies on the ground and how its front runs: one burning body that every look's box
//! touches.
//!
//! **In:** the planes in which the sides and the lower edges of many boxes lie, what the cameras'
//! places and turns may be wrong by, the wind if it is known. **Out:** a [`Shape`]: nodes of a grid,
//! each a possible oval with its place, size and speed, and how likely it is.
//!
//! **How.** The side of a box is a plane through the camera that touches what burns. With `n` its
//! outward normal and `c` the camera, `n . c` is the body's support function at `n`, in perspective
//! and from any side, without an assumption of where in depth the side is. The body is an oval of
//! burning ground, widened by the flames that stand on its rim. The oval keeps its shape while it
//! grows about the place of ignition (the usual shape of fire-spread models): its head is `H + V t`
//! away, its back a share of that, its half width another. Both shares lie about those of Alexander
//! (1985), where length over width gives the ratio of head to back; flanks may be narrower or wider.
//! For each direction of the head and each pair of shares all else is linear and solved by weighted
//! least squares; about each, direction and shares are solved for as well. Nodes are weighed by
//! their evidence.
//!
//! What moves all planes of a flight alike is not noise: heading, tilt and roll of the camera, the
//! scale of a detector's boxes, the range, the lean of the flames. Each is a disturbance with a prior.
//! So is the walk of the reported camera between looks, with the covariance of a random walk, and a
//! flame's edge, which stays alike for some seconds. All of it is in the covariance of the planes, once
//! for all nodes.

mod nodes;
mod oval;
mod scene;

use super::extent::{Measured, Standing, Wind};
use super::outline::Look;
use nalgebra::{SMatrix, Vector2};
use nodes::{FLAME, H, Node, TURN, UNKNOWNS, Unknowns, V, WIDER, nodes, weighed};
use oval::Oval;
use scene::{HALF_WIDTH, Scene, WORTH};

/// What the looks say about the oval.
#[derive(Debug, Clone)]
pub(super) struct Shape {
    nodes: Vec<Node>,
    used_wind: bool,
}

/// Where the head runs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Heading {
    /// Clockwise from north, with one sigma, degrees.
    pub azimuth_deg: Measured,
    /// Probability that it runs to the other side: more than a right angle off.
    pub backwards: f64,
}

impl Shape {
    /// The oval that the looks (seconds before now, in time order) show; `None` for too few.
    pub(super) fn fit(
        looks: &[(f64, &Look)],
        standing: &Standing,
        wind: Option<&Wind>,
    ) -> Option<Self> {
        let scene = Scene::new(looks, standing)?;
        let first = nodes(&scene, 1.0, wind)?;
        let best = first.iter().max_by(|a, b| a.weight.total_cmp(&b.weight))?;
        // The looks' own scatter about the best oval says how much each of them is worth.
        let freedom = (scene.rows.len() as f64 - UNKNOWNS as f64).max(1.0);
        let worth = (freedom / best.misfit.max(1e-9)).clamp(WORTH.0, WORTH.1);
        let nodes = weighed(nodes(&scene, worth, wind)?);
        (!nodes.is_empty()).then_some(Self {
            nodes,
            used_wind: wind.is_some(),
        })
    }

    /// A fire that was seen from one side: a disc of a radius about a place from the foot.
    pub(super) fn disc(centre: Vector2<f64>, centre_sigma_m: f64, radius: &Measured) -> Self {
        let mut solved = Unknowns::zeros();
        (solved[0], solved[1], solved[WIDER]) = (centre.x, centre.y, radius.value);
        let mut covariance = SMatrix::zeros();
        for (unknown, sigma) in [
            (0, centre_sigma_m),
            (1, centre_sigma_m),
            (WIDER, radius.sigma),
        ] {
            covariance[(unknown, unknown)] = sigma * sigma;
        }
        Self {
            nodes: vec![Node {
                oval: Oval::ROUND,
                solved,
                covariance,
                weight: 1.0,
                misfit: 0.0,
            }],
            used_wind: false,
        }
    }

    /// Whether the wind's direction went into it.
    pub(super) fn used_wind(&self) -> bool {
        self.used_wind
    }

    fn best(&self) -> &Node {
        let heavier = |a: &&Node, b: &&Node| a.weight.total_cmp(&b.weight);
        // There is always one: `fit` and `disc` see to it.
        self.nodes.iter().max_by(heavier).unwrap_or(&self.nodes[0])
    }

    fn mean(&self, of: impl Fn(&Node) -> f64) -> f64 {
        self.nodes.iter().map(|node| node.weight * of(node)).sum()
    }

    /// Mean over the nodes of what is linear in the unknowns, with the variance between nodes and
    /// within each.
    fn measured(&self, by: impl Fn(&Node) -> Unknowns) -> Measured {
        let value = self.mean(|node| by(node).dot(&node.solved));
        let variance = self.mean(|node| {
            let by = by(node);
            (by.dot(&node.solved) - value).powi(2) + (node.covariance * by).dot(&by)
        });
        Measured {
            value,
            sigma: variance.max(0.0).sqrt(),
        }
    }

    /// From the near edge to the far one along a line of sight.
    pub(super) fn depth_m(&self, sight: &Vector2<f64>) -> Measured {
        self.measured(|node| {
            let mut by = Unknowns::zeros();
            by[H] = node.oval.reach(sight) + node.oval.reach(&-sight);
            (by[FLAME], by[WIDER]) = (2.0 * HALF_WIDTH, 2.0);
            by
        })
    }

    /// Of the head.
    pub(super) fn speed_m_s(&self) -> Measured {
        self.measured(|_| {
            let mut by = Unknowns::zeros();
            by[V] = 1.0;
            by
        })
    }

    /// Of the edge where the head is, without the error of the fire's position.
    pub(super) fn edge_sigma_m(&self) -> f64 {
        let place = |node: &Node| {
            let mut by = Unknowns::zeros();
            (by[0], by[1], by[H]) = (node.oval.head.x, node.oval.head.y, 1.0);
            (by[FLAME], by[WIDER]) = (HALF_WIDTH, 1.0);
            by
        };
        self.measured(place).sigma
    }

    /// Circular mean and deviation of the head over the nodes, each by how much it points, with what each
    /// is wrong by itself; `None` for what points nowhere.
    pub(super) fn heading(&self) -> Option<Heading> {
        let total = self.mean(|node| node.oval.points());
        if total <= 1e-9 {
            return None;
        }
        let share = |node: &Node| node.weight * node.oval.points() / total;
        let nodes = self.nodes.iter();
        // A normal error of so many radians shortens the mean direction (von Mises).
        let mean: Vector2<f64> = nodes
            .clone()
            .map(|node| node.oval.head * share(node) * (-0.5 * node.covariance[(TURN, TURN)]).exp())
            .sum();
        let length = mean.norm().clamp(1e-6, 1.0 - 1e-9);
        let opposite = nodes.filter(|node| node.oval.head.dot(&mean) < 0.0);
        Some(Heading {
            azimuth_deg: Measured {
                value: mean.x.atan2(mean.y).to_degrees().rem_euclid(360.0),
                sigma: (-2.0 * length.ln()).sqrt().to_degrees(),
            },
            backwards: opposite.map(share).sum(),
        })
    }

    /// Corners of the burning ground from the foot, anticlockwise, each with its speed against the
    /// head's.
    pub(super) fn corners(&self, count: usize) -> Vec<(Vector2<f64>, f64)> {
        let best = self.best();
        let flames = HALF_WIDTH * best.solved[FLAME] + best.solved[WIDER];
        let place = best.solved.xy();
        let corner = |k: usize| {
            let (rim, outwards) = best
                .oval
                .rim(std::f64::consts::TAU * k as f64 / count as f64);
            let at = place + rim * best.solved[H].max(0.0) + outwards * flames.max(0.0);
            (at, best.oval.reach(&outwards))
        };
        (0..count).map(corner).collect()
    }

    /// One sigma of the burning ground's area, as a share: twice that of its mean radius.
    pub(super) fn area_share(&self) -> f64 {
        let radius = self.measured(|node| {
            let mut by = Unknowns::zeros();
            by[H] = ((1.0 + node.oval.back) / 2.0 * node.oval.flank).sqrt();
            (by[FLAME], by[WIDER]) = (HALF_WIDTH, 1.0);
            by
        });
        2.0 * radius.sigma / radius.value.abs().max(1e-3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emberfix_frames::{ServiceTime, Vector3, seconds};

    const FLAME_M: f64 = 1.5;

    /// Support of the true body over the ground, from its place of ignition.
    fn support(oval: &Oval, head_m: f64, outwards: &Vector2<f64>) -> f64 {
        head_m * oval.reach(outwards) + HALF_WIDTH * FLAME_M
    }

    /// A look from a camera at a body whose ignition is the origin: upright planes that touch its
    /// sides, found by halving, and one that touches its near rim.
    fn look(t_s: f64, camera: Vector3<f64>, oval: &Oval, head_m: f64) -> Look {
        let ahead = -camera.xy().normalize();
        let right = Vector2::new(ahead.y, -ahead.x);
        let touching = |side: Vector2<f64>| {
            let normal = |turn: f64| (side * turn.cos() - ahead * turn.sin()).normalize();
            // Leaning back far enough, the plane passes the body on the far side of the camera.
            let passes = |turn: f64| {
                let n = normal(turn);
                n.dot(&camera.xy()) > support(oval, head_m, &n)
            };
            let (mut low, mut high) = (-1.2, 1.2);
            for _ in 0..60 {
                let middle = (low + high) / 2.0;
                if passes(middle) {
                    high = middle;
                } else {
                    low = middle;
                }
            }
            let n = normal(high);
            Vector3::new(n.x, n.y, 0.0)
        };
        let near = -ahead * support(oval, head_m, &-ahead);
        let to_near = Vector3::new(near.x, near.y, 0.0) - camera;
        let lower = to_near.cross(&Vector3::new(right.x, right.y, 0.0));
        let lower = if lower.z > 0.0 { -lower } else { lower };
        let ray =
            |flat: Vector2<f64>, up: f64| (Vector3::new(flat.x, flat.y, up) - camera).normalize();
        let half = support(oval, head_m, &right);
        let rays = [
            ray(-right * half, 1.0),
            ray(right * half, 1.0),
            to_near.normalize(),
            ray(near, 3.0),
        ];
        let planes = [touching(-right), touching(right), lower.normalize()];
        let at = ServiceTime::from_unix_ns(0) + seconds(t_s);
        Look::by_planes(at, camera, planes, rays)
    }

    /// 42 s on a circle about a fire whose head runs at a speed, the last with its foot.
    fn flight(oval: &Oval, speed_m_s: f64) -> (Vec<(f64, Look)>, Standing) {
        let looks: Vec<(f64, Look)> = (0..=60)
            .map(|k| {
                let t_s = f64::from(k) * 0.7 - 42.0;
                let (sin, cos) = (0.08 * t_s).sin_cos();
                let camera = Vector3::new(40.0 * sin, 40.0 * cos, 25.0);
                (t_s, look(t_s + 100.0, camera, oval, 15.0 + speed_m_s * t_s))
            })
            .collect();
        let near = Vector2::y() * support(oval, 15.0, &Vector2::y());
        let standing = Standing {
            foot: Vector3::new(near.x, near.y, 0.0),
            range_share: 0.05,
            wander_m: (0.05, 0.05),
            turn_rad: (0.02, 0.007),
        };
        (looks, standing)
    }

    fn fitted(oval: &Oval, speed_m_s: f64) -> Shape {
        let (looks, standing) = flight(oval, speed_m_s);
        let looks: Vec<(f64, &Look)> = looks.iter().map(|(t_s, look)| (*t_s, look)).collect();
        Shape::fit(&looks, &standing, None).unwrap()
    }

    #[test]
    fn a_front_that_runs_is_found_with_its_speed_direction_and_depth() {
        let azimuth = 70_f64.to_radians();
        let oval = Oval::of(Vector2::new(azimuth.sin(), azimuth.cos()), 1.7, 1.1);
        let shape = fitted(&oval, 0.3);
        let (speed, head) = (shape.speed_m_s(), shape.heading().unwrap().azimuth_deg);
        assert!((speed.value / 0.3 - 1.0).abs() < 0.12, "{speed:?}");
        assert!(
            (speed.value - 0.3).abs() < 2.5 * speed.sigma + 0.02,
            "{speed:?}"
        );
        assert!((head.value - 70.0).abs() < 8.0, "{head:?}");
        let depth = shape.depth_m(&Vector2::y());
        let truth = support(&oval, 15.0, &Vector2::y()) + support(&oval, 15.0, &-Vector2::y());
        assert!((depth.value / truth - 1.0).abs() < 0.1, "{depth:?} {truth}");
    }

    #[test]
    fn an_oval_between_the_cells_of_the_grid_is_found_and_not_told_backwards() {
        for azimuth_deg in [7.5_f64, 97.5, 202.5, 292.5] {
            let azimuth = azimuth_deg.to_radians();
            let head = Vector2::new(azimuth.sin(), azimuth.cos());
            let shape = fitted(&Oval::of(head, 1.75, 1.18), 0.3);
            let heading = shape.heading().unwrap();
            let off = (heading.azimuth_deg.value - azimuth_deg + 540.0).rem_euclid(360.0) - 180.0;
            assert!(off.abs() < 5.0, "{azimuth_deg}: {heading:?}");
            assert!(
                heading.azimuth_deg.sigma < 15.0,
                "{azimuth_deg}: {heading:?}"
            );
            assert!(heading.backwards < 1e-3, "{azimuth_deg}: {heading:?}");
        }
    }

    #[test]
    fn a_fire_that_stands_is_slow_and_one_that_grows_all_around_points_nowhere() {
        let oval = Oval::of(Vector2::x(), 1.7, 1.0);
        let speed = fitted(&oval, 0.0).speed_m_s();
        assert!(speed.value.abs() < 0.03, "{speed:?}");
        let round = fitted(&Oval::ROUND, 0.2);
        let head = round.heading();
        assert!(
            head.is_none_or(|head| head.azimuth_deg.sigma > 20.0),
            "{head:?}"
        );
    }
}
