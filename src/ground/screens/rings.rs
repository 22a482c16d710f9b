//! A closed line on the Earth as rings that flat maps draw rightly: cut at the antimeridian (RFC 7946,
//! 3.1.9), and led along the map's edge where it goes around a pole. Pure.
//!
//! **In:** corners in order, longitude and latitude in degrees, each less than half a turn from the
//! next. **Out:** rings with the same direction, not closed, longitudes from -180 to 180.

/// A corner: longitude, latitude, degrees.
type Corner = [f64; 2];

/// One ring, or one for each side of the antimeridian; none when there are fewer than three corners.
pub(super) fn rings(corners: &[Corner]) -> Vec<Vec<Corner>> {
    let Some(line) = unrolled(corners) else {
        return Vec::new();
    };
    // Unrolled from within one turn, a line of at most one turn reaches one turn to either side.
    [-1.0, 0.0, 1.0]
        .into_iter()
        .map(|turn| shifted(&within_one_turn(&line, 360.0 * turn), -360.0 * turn))
        .filter(|ring| has_area(ring))
        .collect()
}

/// The line without jumps at the antimeridian; with the pole's edge of the map where it goes around it.
fn unrolled(corners: &[Corner]) -> Option<Vec<Corner>> {
    let (&[first, latitude], rest) = corners.split_first()?;
    let mut line = vec![[first, latitude]];
    let mut last = first;
    for &[longitude, latitude] in rest {
        last += short_way(longitude - last);
        line.push([last, latitude]);
    }
    let end = last + short_way(first - last);
    if (end - first).abs() > 180.0 {
        let pole = 90.0_f64.copysign(latitude);
        line.extend([[end, latitude], [end, pole], [first, pole]]);
    }
    (line.len() > 2).then_some(line)
}

/// The same turn by less than half a turn, degrees.
fn short_way(degrees: f64) -> f64 {
    (degrees + 180.0).rem_euclid(360.0) - 180.0
}

/// What lies between the antimeridians around `middle`, degrees (Sutherland and Hodgman 1974).
fn within_one_turn(line: &[Corner], middle: f64) -> Vec<Corner> {
    let east_of_west = cut(line, middle - 180.0, |longitude, edge| longitude >= edge);
    cut(&east_of_west, middle + 180.0, |longitude, edge| {
        longitude <= edge
    })
}

/// The part of a closed line on one side of a meridian.
fn cut(line: &[Corner], edge: f64, is_inside: impl Fn(f64, f64) -> bool) -> Vec<Corner> {
    let mut kept = Vec::new();
    let from = line.iter().cycle().skip(line.len().saturating_sub(1));
    for (from, to) in from.zip(line) {
        let (was_inside, comes_inside) = (is_inside(from[0], edge), is_inside(to[0], edge));
        if was_inside != comes_inside {
            let part = (edge - from[0]) / (to[0] - from[0]);
            kept.push([edge, from[1] + part * (to[1] - from[1])]);
        }
        if comes_inside {
            kept.push(*to);
        }
    }
    kept
}

fn shifted(line: &[Corner], by: f64) -> Vec<Corner> {
    line.iter()
        .map(|[longitude, latitude]| [longitude + by, *latitude])
        .collect()
}

/// A cut that only touches leaves a line, or nothing.
fn has_area(ring: &[Corner]) -> bool {
    ring.len() > 2 && area(ring).abs() > 0.0
}

/// Square degrees; positive anticlockwise.
fn area(ring: &[Corner]) -> f64 {
    let next = ring.iter().cycle().skip(1);
    let doubled: f64 = ring
        .iter()
        .zip(next)
        .map(|(a, b)| (b[0] - a[0]) * (a[1] + b[1]))
        .sum();
    -doubled / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A circle around a place, degrees; near a pole in the plane of the pole.
    fn around(longitude: f64, latitude: f64, radius: f64) -> Vec<Corner> {
        let corner = |k: u32| {
            let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / 16.0).sin_cos();
            let longitude = short_way(longitude + radius * cos);
            [longitude, latitude + radius * sin]
        };
        (0..16).map(corner).collect()
    }

    fn spans(ring: &[Corner]) -> bool {
        ring.iter()
            .zip(ring.iter().cycle().skip(1))
            .any(|(a, b)| (a[0] - b[0]).abs() > 180.0)
    }

    #[test]
    fn a_ring_in_the_middle_of_the_map_stays_as_it_is() {
        let corners = around(119.0, 31.0, 0.1);
        assert_eq!(rings(&corners), [corners]);
        assert!(rings(&[[1.0, 2.0], [3.0, 4.0]]).is_empty());
    }

    #[test]
    fn at_the_antimeridian_there_is_one_ring_on_each_side_and_no_ground_is_lost() {
        for middle in [179.95, -179.95, 180.0] {
            let corners = around(middle, -16.5, 0.1);
            let found = rings(&corners);
            assert_eq!(found.len(), 2, "{middle}");
            assert!(found.iter().all(|ring| !spans(ring)), "{found:?}");
            let whole = area(&around(0.0, -16.5, 0.1));
            let cut: f64 = found.iter().map(|ring| area(ring)).sum();
            assert!(
                (cut - whole).abs() < 1e-9,
                "{cut} of {whole}, same direction"
            );
            let on_map = |corner: &Corner| (-180.0..=180.0).contains(&corner[0]);
            assert!(found.iter().flatten().all(on_map), "{found:?}");
        }
        // It touches the edge and does not cross it.
        let touching = [[179.0, 0.0], [180.0, 0.5], [179.0, 1.0]];
        assert_eq!(rings(&touching).len(), 1);
    }

    #[test]
    fn around_a_pole_the_ring_runs_along_the_edge_of_the_map() {
        for (pole, east) in [(90.0, 1.0), (-90.0, -1.0)] {
            // Anticlockwise seen from above: eastwards around the north pole, westwards around the south.
            let latitude = pole - 0.01_f64.copysign(pole);
            let corners: Vec<Corner> = (0..16)
                .map(|k| [short_way(10.0 + east * 22.5 * f64::from(k)), latitude])
                .collect();
            let found = rings(&corners);
            let ground: f64 = found.iter().map(|ring| area(ring)).sum();
            assert!(
                (ground - 3.6).abs() < 1e-9,
                "{pole}: {ground} of 360 x 0.01 square degrees"
            );
            let edges = found.iter().flatten().filter(|corner| corner[1] == pole);
            assert!(edges.count() >= 2, "{found:?}");
        }
    }
}
