//! Square markers with a number in their pattern: OpenCV's predefined ArUco dictionaries.

mod bits;

use bits::{BITS_4, BITS_5, BITS_6, BITS_7};

/// A set of markers, by the bits on a side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dictionary {
    /// 4x4 bits.
    Four,
    /// 5x5 bits.
    Five,
    /// 6x6 bits.
    Six,
    /// 7x7 bits.
    Seven,
}

/// Markers that a dictionary holds here.
pub(super) const MARKERS: usize = 250;

impl Dictionary {
    /// Reads `4x4`, `4x4_50`, `DICT_5X5_250` and the like: sets of one size begin alike, and a board needs
    /// no more than 250 markers.
    #[must_use]
    pub fn parse(name: &str) -> Option<Self> {
        let name = name.to_lowercase();
        let name = name.strip_prefix("dict_").unwrap_or(&name);
        let (size, count) = name.split_once('_').unwrap_or((name, "250"));
        if !["50", "100", "250", "1000"].contains(&count) {
            return None;
        }
        match size {
            "4x4" => Some(Self::Four),
            "5x5" => Some(Self::Five),
            "6x6" => Some(Self::Six),
            "7x7" => Some(Self::Seven),
            _ => None,
        }
    }

    /// Bits on a side, without the black border of one bit around them.
    #[must_use]
    pub fn side_bits(self) -> usize {
        match self {
            Self::Four => 4,
            Self::Five => 5,
            Self::Six => 6,
            Self::Seven => 7,
        }
    }

    fn markers(self) -> &'static [u64; MARKERS] {
        match self {
            Self::Four => &BITS_4,
            Self::Five => &BITS_5,
            Self::Six => &BITS_6,
            Self::Seven => &BITS_7,
        }
    }

    /// Bits that may be read wrongly: half of those by which markers of a set differ at least.
    fn wrong_bits(self) -> u32 {
        match self {
            Self::Four => 1,
            Self::Five => 2,
            Self::Six => 4,
            Self::Seven => 6,
        }
    }

    /// Whether a bit of a marker is white; `None` without such a marker or bit.
    #[must_use]
    pub fn is_white(self, marker: usize, row: usize, column: usize) -> Option<bool> {
        let side = self.side_bits();
        let code = self.markers().get(marker)?;
        let inside = row < side && column < side;
        inside.then(|| code >> (side * side - 1 - row * side - column) & 1 == 1)
    }

    /// Which of the first `count` markers a pattern is (row by row, white is true), and by how many quarter
    /// turns clockwise the pattern must be turned to stand upright.
    pub(super) fn identify(self, pattern: &[bool], count: usize) -> Option<(usize, usize)> {
        let side = self.side_bits();
        let mut turned = pattern.to_vec();
        let mut best: Option<(u32, usize, usize)> = None;
        for turns in 0..4 {
            let code = turned
                .iter()
                .fold(0_u64, |code, white| code << 1 | u64::from(*white));
            for (id, marker) in self.markers().iter().take(count).enumerate() {
                let wrong = (marker ^ code).count_ones();
                if best.is_none_or(|(least, ..)| wrong < least) {
                    best = Some((wrong, id, turns));
                }
            }
            turned = clockwise(&turned, side);
        }
        best.filter(|(wrong, ..)| *wrong <= self.wrong_bits())
            .map(|(_, id, turns)| (id, turns))
    }
}

/// The pattern turned by a quarter clockwise.
fn clockwise(pattern: &[bool], side: usize) -> Vec<bool> {
    let from = |row: usize, column: usize| pattern[(side - 1 - column) * side + row];
    (0..side * side)
        .map(|at| from(at / side, at % side))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_marker_is_known_again_whichever_way_up_and_with_a_wrong_bit() {
        for dictionary in ["4x4_50", "DICT_5X5_250", "6x6", "7x7_100"] {
            let dictionary = Dictionary::parse(dictionary).unwrap();
            let side = dictionary.side_bits();
            for id in [0, 7, 49] {
                let mut pattern: Vec<bool> = (0..side * side)
                    .map(|at| dictionary.is_white(id, at / side, at % side).unwrap())
                    .collect();
                pattern[3] = !pattern[3];
                for turned in 0..4 {
                    let found = dictionary.identify(&pattern, 50);
                    assert_eq!(found, Some((id, (4 - turned) % 4)), "{dictionary:?}");
                    pattern = clockwise(&pattern, side);
                }
            }
        }
        assert_eq!(Dictionary::parse("4x4_51"), None);
        assert_eq!(Dictionary::parse("original"), None);
    }
}
