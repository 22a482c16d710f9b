//! One measured number, and what it has to keep to.

use serde::{Serialize, Serializer};

/// What a figure has to keep to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// The value itself must come out.
    Equals(f64),
    /// No more than this.
    AtMost(f64),
    /// No less than this.
    AtLeast(f64),
    /// Between the two, both included.
    Within(f64, f64),
}

impl Bound {
    /// Whether a value keeps to it. NaN never does.
    #[must_use]
    pub fn holds(&self, value: f64) -> bool {
        match *self {
            Self::Equals(bound) => value == bound,
            Self::AtMost(bound) => value <= bound,
            Self::AtLeast(bound) => value >= bound,
            Self::Within(low, high) => (low..=high).contains(&value),
        }
    }
}

/// One number, or the two ends of the allowed range.
impl Serialize for Bound {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match *self {
            Self::Equals(bound) | Self::AtMost(bound) | Self::AtLeast(bound) => {
                bound.serialize(serializer)
            }
            Self::Within(low, high) => [low, high].serialize(serializer),
        }
    }
}

impl std::fmt::Display for Bound {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match *self {
            Self::Equals(bound) => write!(f, "must be {bound}"),
            Self::AtMost(bound) => write!(f, "at most {bound}"),
            Self::AtLeast(bound) => write!(f, "at least {bound}"),
            Self::Within(low, high) => write!(f, "{low} to {high}"),
        }
    }
}

/// One measured number and the bound that it must hold.
///
/// Serialises as `{"name", "value", "unit", "bound", "holds", "n"}`, the shape that every `--json`
/// output of this project carries in its list `figures`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figure {
    /// Its name, such as `location.coverage90_rtk`.
    pub name: String,
    /// What was measured; null when nothing was.
    pub value: Option<f64>,
    /// Its unit; empty for a pure number.
    pub unit: &'static str,
    /// What it must keep to; null when nobody set anything.
    pub bound: Option<Bound>,
    /// Whether it does. A bound that nothing was measured against does not hold.
    pub holds: bool,
    /// How many samples it rests on.
    pub n: usize,
}

impl Figure {
    /// A figure that must keep to a bound.
    #[must_use]
    pub fn bounded(
        name: impl Into<String>,
        value: Option<f64>,
        unit: &'static str,
        bound: Bound,
        n: usize,
    ) -> Self {
        Self {
            name: name.into(),
            value,
            unit,
            bound: Some(bound),
            holds: value.is_some_and(|value| bound.holds(value)),
            n,
        }
    }

    /// A figure that is told, and has no bound.
    #[must_use]
    pub fn told(name: impl Into<String>, value: Option<f64>, unit: &'static str, n: usize) -> Self {
        Self {
            name: name.into(),
            value,
            unit,
            bound: None,
            holds: true,
            n,
        }
    }
}

/// A figure as a line for people.
impl std::fmt::Display for Figure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let value = self
            .value
            .map_or_else(|| "none".to_owned(), |value| format!("{value:.4}"));
        let bound = self
            .bound
            .map_or_else(String::new, |bound| format!(", {bound}"));
        let verdict = if self.holds { "" } else { "  DOES NOT HOLD" };
        write!(
            f,
            "{:38} {value} {}{bound} (n = {}){verdict}",
            self.name, self.unit, self.n
        )
    }
}

/// All figures, one line each.
#[must_use]
pub fn text_lines(figures: &[Figure]) -> String {
    let lines: Vec<String> = figures.iter().map(ToString::to_string).collect();
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn serialises_as_the_contract_says() {
        let figure = Figure::bounded("a.b", Some(0.5), "m", Bound::AtMost(1.0), 3);
        assert_eq!(
            serde_json::to_string(&figure).unwrap(),
            r#"{"name":"a.b","value":0.5,"unit":"m","bound":1.0,"holds":true,"n":3}"#
        );
        let range = Figure::bounded("c", Some(0.5), "", Bound::Within(0.6, 0.7), 1);
        assert!(
            serde_json::to_string(&range)
                .unwrap()
                .contains(r#""bound":[0.6,0.7],"holds":false"#)
        );
    }

    #[test]
    fn nothing_measured_holds_no_bound() {
        assert!(!Figure::bounded("a", None, "m", Bound::AtLeast(0.0), 0).holds);
        assert!(!Bound::AtMost(1.0).holds(f64::NAN));
    }
}
