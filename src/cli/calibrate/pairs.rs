//! Which files are the two eyes of one moment, by their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Two files of one moment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FilePair {
    /// What their names have in common.
    pub name: String,
    /// Left eye.
    pub left: PathBuf,
    /// Right eye.
    pub right: PathBuf,
}

/// What names call the eyes; letters stand alone, words anywhere.
const WORDS: [(&str, &str); 6] = [
    ("left", "right"),
    ("cam0", "cam1"),
    ("camera0", "camera1"),
    ("cam_0", "cam_1"),
    ("nir", "vis"),
    ("l", "r"),
];

const ENDINGS: [&str; 7] = ["png", "jpg", "jpeg", "bmp", "tif", "tiff", "pgm"];

/// Image files of a list of files and folders; folders are looked through.
///
/// # Errors
/// When a folder can't be read.
pub fn images(places: &[PathBuf]) -> std::io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for place in places {
        if place.is_dir() {
            collect(place, 0, &mut found)?;
        } else {
            found.push(place.clone());
        }
    }
    found.sort();
    found.dedup();
    Ok(found)
}

/// `mav0/cam0/data/TIME.png` is four folders deep; more is another folder's business.
const DEEPEST: usize = 5;

fn collect(folder: &Path, depth: usize, found: &mut Vec<PathBuf>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() && depth < DEEPEST {
            collect(&path, depth + 1, found)?;
        } else if is_image(&path) {
            found.push(path);
        }
    }
    Ok(())
}

fn is_image(path: &Path) -> bool {
    let ending = path
        .extension()
        .map(|ending| ending.to_string_lossy().to_ascii_lowercase());
    ending.is_some_and(|ending| ENDINGS.contains(&ending.as_str()))
}

/// The pairs among the files, by the first way of naming eyes that pairs any; in order of names.
#[must_use]
pub fn pair_up(files: &[PathBuf]) -> Vec<FilePair> {
    for (left, right) in WORDS {
        let mut by_rest: BTreeMap<String, (Option<PathBuf>, Option<PathBuf>)> = BTreeMap::new();
        for file in files {
            let text = file.to_string_lossy();
            // What stands last in the path tells: a folder may be called left_right.
            match (named_at(&text, left), named_at(&text, right)) {
                (Some(at), other) if other.is_none_or(|other| other < at) => {
                    let rest = without(&text, at, left);
                    by_rest.entry(rest).or_default().0 = Some(file.clone());
                }
                (_, Some(at)) => {
                    let rest = without(&text, at, right);
                    by_rest.entry(rest).or_default().1 = Some(file.clone());
                }
                _ => {}
            }
        }
        let pairs: Vec<FilePair> = by_rest
            .into_iter()
            .filter_map(|(rest, pair)| match pair {
                (Some(left), Some(right)) => Some(FilePair {
                    name: short(&rest),
                    left,
                    right,
                }),
                _ => None,
            })
            .collect();
        if !pairs.is_empty() {
            return pairs;
        }
    }
    Vec::new()
}

/// The last place of the path that names this eye. A name counts where no letter touches it: `left01`,
/// `img_L_3`, `cam0/`.
fn named_at(path: &str, eye: &str) -> Option<usize> {
    let lower = path.to_ascii_lowercase();
    let touches = |character: Option<char>| character.is_some_and(char::is_alphabetic);
    lower.rmatch_indices(eye).map(|(at, _)| at).find(|&at| {
        let after = at + eye.len();
        // A digit after a digit is another number: cam0 is not in cam01.
        let more = eye.ends_with(|c: char| c.is_ascii_digit())
            && lower[after..].starts_with(|c: char| c.is_ascii_digit());
        !touches(lower[..at].chars().next_back())
            && !touches(lower[after..].chars().next())
            && !more
    })
}

/// The path with the eye's name at a place taken out.
fn without(path: &str, at: usize, eye: &str) -> String {
    format!("{}*{}", &path[..at], &path[at + eye.len()..])
}

/// The part of a name that tells pairs apart, for people.
fn short(rest: &str) -> String {
    let path = Path::new(rest);
    let stem = path.file_stem().map(|stem| stem.to_string_lossy());
    let stem = stem.unwrap_or_default();
    let pieces = stem
        .split('*')
        .map(|piece| piece.trim_matches(|c: char| !c.is_alphanumeric()));
    // Numbers tell moments apart; `img` does not.
    let numbered = |piece: &&str| piece.contains(|c: char| c.is_ascii_digit());
    let all: Vec<&str> = pieces.filter(|piece| !piece.is_empty()).collect();
    let told = all.iter().copied().rfind(numbered);
    told.or(all.last().copied()).unwrap_or(rest).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(files: &[&str]) -> Vec<(String, String, String)> {
        let files: Vec<PathBuf> = files.iter().map(PathBuf::from).collect();
        let text = |path: PathBuf| path.to_string_lossy().into_owned();
        pair_up(&files)
            .into_iter()
            .map(|pair| (pair.name, text(pair.left), text(pair.right)))
            .collect()
    }

    #[test]
    fn usual_names_are_paired() {
        for files in [
            ["left01.jpg", "right01.jpg"],
            ["a/left/01.png", "a/right/01.png"],
            ["img_L_01.png", "img_R_01.png"],
            ["01_l.png", "01_r.png"],
            ["mav0/cam0/data/01.png", "mav0/cam1/data/01.png"],
            ["NIR-01.png", "VIS-01.png"],
        ] {
            let pairs = names(&files);
            assert_eq!(pairs.len(), 1, "{files:?}");
            assert_eq!((&pairs[0].1[..], &pairs[0].2[..]), (files[0], files[1]));
            assert_eq!(pairs[0].0, "01");
        }
    }

    #[test]
    fn what_has_no_partner_stays_alone() {
        assert_eq!(names(&["left01.jpg", "right02.jpg"]), []);
        assert_eq!(
            names(&["girl.png", "rig.png"]),
            [],
            "letters inside words name no eye"
        );
        assert_eq!(names(&["cam01_3.png", "cam11_3.png"]), []);
    }

    #[test]
    fn the_folders_own_name_does_not_count_when_the_file_tells() {
        let pairs = names(&["left_right/left1.png", "left_right/right1.png"]);
        assert_eq!(pairs.len(), 1);
        assert_eq!(pairs[0].1, "left_right/left1.png");
    }
}
