//! `emberfix doctor MISSION`.

use crate::cli::Failure;
use crate::doctor::{Examination, Finding, Options, Section, Verdict, examine};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;
use std::fmt::Write;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::time::Duration;

/// Checks a mission before take-off.
#[derive(Debug, clap::Args)]
pub struct DoctorArguments {
    /// Mission file, such as missions/gaochun.toml.
    mission: PathBuf,
    /// How long to listen to camera and autopilot.
    #[arg(long, value_name = "N", default_value_t = 8.0, value_parser = seconds)]
    seconds: f64,
    /// Wait for camera and autopilot to come, this long at most.
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "120", value_parser = seconds)]
    wait: Option<f64>,
    /// Print one JSON object instead of the table.
    #[arg(long)]
    json: bool,
    /// MAVLink URL instead of the mission's.
    #[arg(long, value_name = "URL")]
    mavlink: Option<String>,
    /// Camera URL instead of the mission's.
    #[arg(long, value_name = "URL")]
    camera: Option<String>,
    /// Address of the ground station instead of the mission's.
    #[arg(long, value_name = "URL")]
    ground: Option<String>,
    /// Folder for what must survive (the outbox) instead of the mission's.
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
}

/// Longest that the doctor may be asked to listen or to wait, seconds.
const LONGEST_S: f64 = 3600.0;

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (1.0..=LONGEST_S).contains(&value) => Ok(value),
        _ => Err(format!("allowed are 1 to {LONGEST_S} seconds")),
    }
}

/// Examines, prints, and fails when a finding does.
pub fn doctor(arguments: &DoctorArguments) -> Result<(), Failure> {
    let options = Options {
        mavlink: arguments.mavlink.clone(),
        camera: arguments.camera.clone(),
        ground: arguments.ground.clone(),
        state: arguments.state.clone(),
        listen: Duration::from_secs_f64(arguments.seconds),
        patience: Duration::from_secs_f64(arguments.wait.unwrap_or(0.0)),
    };
    let spinner = spinner();
    let examination = examine(&arguments.mission, &options, &|doing| {
        spinner.set_message(doing.to_owned());
    });
    spinner.finish_and_clear();
    if arguments.json {
        println!("{:#}", as_json(&examination));
    } else {
        let paint = Paint {
            colours: std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none(),
            width: width(),
        };
        print!("{}", paint.examination(&examination));
    }
    if examination.refused {
        return Err(Failure::Refused(anyhow::anyhow!(
            "the mission can't be flown as it is written"
        )));
    }
    match examination.count(Verdict::Fail) {
        0 => Ok(()),
        1 => Err(Failure::Failed(anyhow::anyhow!("one check failed"))),
        fails => Err(Failure::Failed(anyhow::anyhow!("{fails} checks failed"))),
    }
}

fn spinner() -> ProgressBar {
    let spinner = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{spinner} {msg}, {elapsed}") {
        spinner.set_style(style);
    }
    spinner.enable_steady_tick(Duration::from_millis(120));
    spinner
}

fn as_json(examination: &Examination) -> serde_json::Value {
    let mut value = json!(examination);
    value["verdict"] = json!(examination.verdict());
    value["figures"] = json!(examination.figures());
    value
}

/// Columns of the terminal, within what is pleasant to read.
fn width() -> usize {
    let columns = std::env::var("COLUMNS").ok().and_then(|c| c.parse().ok());
    let columns = columns.or_else(|| console_columns(std::io::stdout().is_terminal()));
    columns.unwrap_or(100).clamp(60, 110)
}

fn console_columns(is_terminal: bool) -> Option<usize> {
    if !is_terminal {
        return None;
    }
    let mut table = comfy_table::Table::new();
    table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic);
    table.width().map(usize::from)
}

/// How the findings look.
struct Paint {
    colours: bool,
    width: usize,
}

/// Columns before the name, before the value.
const NAME_AT: usize = 8;
const VALUE_AT: usize = 26;

const BOLD: &str = "1";
const GREEN: &str = "32";
const YELLOW: &str = "1;33";
const RED: &str = "1;31";

impl Paint {
    fn examination(&self, examination: &Examination) -> String {
        let mut text = String::new();
        for section in &examination.sections {
            self.section(&mut text, section);
        }
        let _ = writeln!(text, "{}", self.conclusion(examination));
        text
    }

    fn section(&self, text: &mut String, section: &Section) {
        let _ = writeln!(text, "{}", self.coloured(BOLD, section.title));
        for finding in &section.findings {
            self.finding(text, finding);
        }
        text.push('\n');
    }

    fn finding(&self, text: &mut String, finding: &Finding) {
        let (word, colour) = match finding.verdict {
            Verdict::Pass => ("pass", GREEN),
            Verdict::Warn => ("WARN", YELLOW),
            Verdict::Fail => ("FAIL", RED),
        };
        let mut lines = wrapped(&finding.value, self.width - VALUE_AT).into_iter();
        let first = lines.next().unwrap_or_default();
        let _ = writeln!(
            text,
            "  {}  {:name$}{first}",
            self.coloured(colour, word),
            finding.name,
            name = VALUE_AT - NAME_AT,
        );
        for line in lines {
            let _ = writeln!(text, "{:VALUE_AT$}{line}", "");
        }
        for (n, line) in wrapped(&finding.remedy, self.width - VALUE_AT - 3)
            .iter()
            .enumerate()
        {
            let mark = if n == 0 { "->" } else { "  " };
            let _ = writeln!(
                text,
                "{:VALUE_AT$}{} {line}",
                "",
                self.coloured(colour, mark)
            );
        }
    }

    fn conclusion(&self, examination: &Examination) -> String {
        let count = |verdict| examination.count(verdict);
        let (pass, warn, fail) = (
            count(Verdict::Pass),
            count(Verdict::Warn),
            count(Verdict::Fail),
        );
        let (word, colour) = match examination.verdict() {
            Verdict::Pass => ("READY", GREEN),
            Verdict::Warn => ("READY, with warnings", YELLOW),
            Verdict::Fail => ("NOT READY", RED),
        };
        format!(
            "{}: {}, {pass} pass, {warn} warn, {fail} fail, in {:.0} s",
            self.coloured(colour, word),
            examination.mission,
            examination.took_s
        )
    }

    fn coloured(&self, colour: &str, text: &str) -> String {
        if self.colours {
            format!("\u{1b}[{colour}m{text}\u{1b}[0m")
        } else {
            text.to_owned()
        }
    }
}

/// Lines of at most `width` characters, broken at spaces.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(sections: Vec<Section>) -> String {
        let paint = Paint {
            colours: false,
            width: 60,
        };
        paint.examination(&Examination {
            mission: "gaochun".to_owned(),
            began_at: emberfix_frames::ServiceTime::from_unix_ns(0),
            took_s: 9.4,
            refused: false,
            sections,
        })
    }

    #[test]
    fn a_failure_shows_what_was_found_and_what_to_do() {
        let findings = vec![
            Finding::pass("heartbeat", "system 1, disarmed"),
            Finding::fail(
                "GNSS",
                "no fix",
                "wait under open sky until the fix is good enough",
            ),
        ];
        let text = drawn(vec![Section {
            title: "Autopilot",
            findings,
        }]);
        let expected = "Autopilot\n\
            \x20 pass  heartbeat         system 1, disarmed\n\
            \x20 FAIL  GNSS              no fix\n\
            \x20                         -> wait under open sky until the\n\
            \x20                            fix is good enough\n\
            \n\
            NOT READY: gaochun, 1 pass, 0 warn, 1 fail, in 9 s\n";
        assert_eq!(text, expected);
    }

    #[test]
    fn no_line_is_wider_than_the_terminal_and_no_word_is_lost() {
        let text = "one two three four five six seven eight nine ten eleven twelve".to_owned();
        let lines = wrapped(&text, 20);
        assert!(lines.iter().all(|line| line.chars().count() <= 20));
        assert_eq!(lines.join(" "), text);
    }
}
