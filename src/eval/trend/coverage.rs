//! How many 90 % intervals hold the truth, and how surely that is known.

use super::flights::Pair;
use crate::eval::Table;

/// 95 % of a normal distribution lie within so many sigmas.
const Z95: f64 = 1.959_964;

/// Share that holds, and the 95 % interval of that share for so many trials (Wilson 1927).
fn share(pairs: &[Pair]) -> Option<(f64, [f64; 2])> {
    if pairs.is_empty() {
        return None;
    }
    let n = pairs.len() as f64;
    let held = pairs.iter().filter(|pair| pair.holds90()).count() as f64 / n;
    let z2 = Z95 * Z95 / n;
    let middle = (held + z2 / 2.0) / (1.0 + z2);
    let half = Z95 * (held * (1.0 - held) / n + z2 / (4.0 * n)).sqrt() / (1.0 + z2);
    Some((held, [middle - half, middle + half]))
}

/// For people.
pub(super) fn table(kinds: &[(&'static str, Vec<Pair>)]) -> Table {
    let row = |(name, pairs): &(&str, Vec<Pair>)| {
        let (held, between) = share(pairs).map_or(("-".to_owned(), "-".to_owned()), |told| {
            let [low, high] = told.1;
            (format!("{:.3}", told.0), format!("{low:.3} to {high:.3}"))
        });
        vec![(*name).to_owned(), pairs.len().to_string(), held, between]
    };
    let header = ["quantity", "n", "held", "95 % interval of that"];
    Table {
        title: "Truth within the told 90 % interval".to_owned(),
        header: header.map(str::to_owned).to_vec(),
        rows: kinds.iter().map(row).collect(),
    }
}

/// For programs.
pub(super) fn details(kinds: &[(&'static str, Vec<Pair>)]) -> serde_json::Value {
    let of = |(name, pairs): &(&'static str, Vec<Pair>)| {
        let told = share(pairs);
        serde_json::json!({
            "quantity": name,
            "n": pairs.len(),
            "held": told.map(|told| told.0),
            "interval95": told.map(|told| told.1),
        })
    };
    kinds.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ninety_of_a_hundred_are_known_to_six_points() {
        let pair = |k: u32| Pair {
            told: 0.0,
            sigma: 1.0,
            truth: if k < 90 { 1.0 } else { 2.0 },
        };
        let pairs: Vec<Pair> = (0..100).map(pair).collect();
        let (held, [low, high]) = share(&pairs).unwrap();
        assert!((held - 0.9).abs() < 1e-12);
        // Wilson's interval for 90 of 100 is 0.826 to 0.945 (Newcombe 1998's method 3).
        assert!(
            (low - 0.8256).abs() < 1e-3 && (high - 0.9448).abs() < 1e-3,
            "{low} {high}"
        );
        assert_eq!(share(&[]), None);
    }
}
