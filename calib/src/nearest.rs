//! Helpful words for keys and values that a configuration file should not have; shared by every
//! file that the project reads.

/// One key that nothing reads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyProblem {
    /// Full key, such as `left.focal_pix`.
    pub key: String,
    /// The known key that it resembles most, if any does.
    pub nearest: Option<String>,
}

impl std::fmt::Display for KeyProblem {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "key {} is unknown", self.key)?;
        match &self.nearest {
            Some(nearest) => write!(f, "; did you mean {nearest}?"),
            None => Ok(()),
        }
    }
}

/// The known key most like `key`, if it is like it at all.
#[must_use]
pub fn nearest_key<'a>(key: &str, known: &[&'a str]) -> Option<&'a str> {
    known
        .iter()
        .map(|candidate| (strsim::jaro_winkler(key, candidate), *candidate))
        .filter(|(likeness, _)| *likeness > 0.75)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, candidate)| candidate)
}

/// Every key of `table` that `known` does not list. A known key that ends in `.*` takes in
/// everything beneath it; arrays of tables are looked through with the array's own name.
#[must_use]
pub fn unknown_keys(table: &toml::Table, known: &[&str]) -> Vec<KeyProblem> {
    let mut found = Vec::new();
    collect(table, "", known, &mut found);
    found
}

fn collect(table: &toml::Table, prefix: &str, known: &[&str], found: &mut Vec<KeyProblem>) {
    for (name, value) in table {
        let key = format!("{prefix}{name}");
        if known.contains(&format!("{key}.*").as_str()) {
            continue;
        }
        match value {
            toml::Value::Table(inner) if has_children(&key, known) => {
                collect(inner, &format!("{key}."), known, found);
            }
            toml::Value::Array(items) if has_children(&key, known) => {
                for inner in items.iter().filter_map(toml::Value::as_table) {
                    collect(inner, &format!("{key}."), known, found);
                }
            }
            _ if known.contains(&key.as_str()) => {}
            _ => found.push(KeyProblem {
                nearest: nearest_key(&key, known).map(str::to_owned),
                key,
            }),
        }
    }
}

fn has_children(key: &str, known: &[&str]) -> bool {
    known
        .iter()
        .any(|candidate| candidate.starts_with(&format!("{key}.")))
}

/// Collects "key is value, allowed is range" for every value out of range; not-a-number always is.
#[derive(Debug, Default)]
pub struct Checks {
    problems: Vec<String>,
}

impl Checks {
    /// No problem yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Refuses a value outside `low..=high`; `hint` is added to the sentence (unit, usual mistake).
    pub fn range(&mut self, key: &str, value: f64, low: f64, high: f64, hint: &str) {
        if !(low..=high).contains(&value) {
            self.problems.push(format!(
                "{key} is {value}, allowed is {low} to {high}{hint}"
            ));
        }
    }

    /// Any other problem, as one sentence that names key, value and remedy.
    pub fn problem(&mut self, sentence: String) {
        self.problems.push(sentence);
    }

    /// All problems, in the order in which they were found.
    #[must_use]
    pub fn into_problems(self) -> Vec<String> {
        self.problems
    }
}

/// What the TOML reader says, in one line, with the line of the file that it says it of.
#[must_use]
pub fn toml_problem(text: &str, error: &toml::de::Error) -> String {
    let message = error.message().replace('\n', ", ");
    let before = error.span().and_then(|span| text.get(..span.start));
    // A key that is missing from the whole file is said of its first byte.
    let Some(before) = before.filter(|before| !before.is_empty()) else {
        return message;
    };
    let number = before.matches('\n').count();
    let line = text.lines().nth(number).unwrap_or_default().trim();
    format!("line {} ({line}): {message}", number + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_misspelt_key_is_named_with_its_nearest() {
        let table: toml::Table =
            toml::from_str("[left]\nfocal_pix = 1\n[free]\nanything = 2").unwrap();
        let problems = unknown_keys(&table, &["left.focal_px", "left.distortion", "free.*"]);
        assert_eq!(problems.len(), 1);
        assert_eq!(
            problems[0].to_string(),
            "key left.focal_pix is unknown; did you mean left.focal_px?"
        );
    }
}
