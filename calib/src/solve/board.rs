//! The board: what is printed on it, and where its corners are.

use super::dictionary::Dictionary;
use emberfix_frames::Vector3;

/// What is printed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum BoardKind {
    /// A chessboard.
    Chessboard,
    /// A chessboard with ArUco markers in its white squares.
    Charuco {
        /// Markers by their OpenCV name.
        dictionary: Dictionary,
        /// Side of a marker over side of a square.
        marker_share: f64,
    },
}

/// A flat board with a grid of corners; X along its rows, Y along its columns, Z away from the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
    /// What is printed.
    pub kind: BoardKind,
    /// Inner corners in a row.
    pub columns: usize,
    /// Rows of inner corners.
    pub rows: usize,
    /// Side of a square, metres.
    pub square_m: f64,
}

/// Why a board's description was refused.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum BoardError {
    /// Not a description.
    #[error(
        "board {given:?}: needed is COLUMNSxROWS of inner corners, such as 9x6, or \
         charuco:COLUMNSxROWS:DICTIONARY of squares, such as charuco:11x8:4x4_50"
    )]
    Form {
        /// What was given.
        given: String,
    },
    /// A number of corners that no board has.
    #[error("board {given:?}: {corners} corners on a side, allowed is 3 to 40")]
    Corners {
        /// What was given.
        given: String,
        /// The number.
        corners: usize,
    },
    /// A chessboard that looks the same from two sides.
    #[error(
        "board {given:?}: a chessboard with as many rows as columns has no up; use one such as 9x6"
    )]
    Square {
        /// What was given.
        given: String,
    },
    /// An unknown set of markers.
    #[error("board {given:?}: dictionary {dictionary:?} is unknown, known are {known}")]
    Dictionary {
        /// What was given.
        given: String,
        /// The name in it.
        dictionary: String,
        /// Names that are known.
        known: String,
    },
    /// A size in the wrong unit.
    #[error("square side {square_m} m, allowed is 0.002 to 1 (was it given in mm?)")]
    SquareSide {
        /// Metres.
        square_m: f64,
    },
    /// A marker that does not fit its square.
    #[error("marker side is {share} of the square's, allowed is 0.3 to 0.95")]
    MarkerSide {
        /// Marker over square.
        share: f64,
    },
}

/// Marker over square where nothing is said: what OpenCV's and calib.io's generators use.
const MARKER_SHARE: f64 = 0.75;

impl Board {
    /// Reads `9x6` (inner corners) or `charuco:11x8:4x4_50` (squares, dictionary).
    ///
    /// # Errors
    /// [`BoardError`].
    pub fn parse(given: &str, square_m: f64) -> Result<Self, BoardError> {
        if !(0.002..=1.0).contains(&square_m) {
            return Err(BoardError::SquareSide { square_m });
        }
        match given.strip_prefix("charuco:") {
            None => chessboard(given, square_m),
            Some(rest) => charuco(given, rest, square_m),
        }
    }

    /// The same board with markers of another size; nothing changes on a chessboard.
    ///
    /// # Errors
    /// [`BoardError::MarkerSide`].
    pub fn with_marker_m(mut self, marker_m: f64) -> Result<Self, BoardError> {
        if let BoardKind::Charuco { marker_share, .. } = &mut self.kind {
            let share = marker_m / self.square_m;
            if !(0.3..=0.95).contains(&share) {
                return Err(BoardError::MarkerSide { share });
            }
            *marker_share = share;
        }
        Ok(self)
    }

    /// Number of inner corners.
    #[must_use]
    pub fn corners(&self) -> usize {
        self.columns * self.rows
    }

    /// Where a corner is on the board, metres.
    #[must_use]
    pub fn point_m(&self, id: usize) -> Vector3<f64> {
        let (column, row) = (id % self.columns, id / self.columns);
        Vector3::new(column as f64, row as f64, 0.0) * self.square_m
    }

    /// Whether half a turn changes the pattern: then the corners can be numbered in one way only.
    #[must_use]
    pub fn has_one_way_up(&self) -> bool {
        matches!(self.kind, BoardKind::Charuco { .. }) || (self.columns + self.rows) % 2 == 1
    }
}

fn chessboard(given: &str, square_m: f64) -> Result<Board, BoardError> {
    let (columns, rows) = sides(given, given)?;
    if columns == rows {
        return Err(BoardError::Square {
            given: given.to_owned(),
        });
    }
    Ok(Board {
        kind: BoardKind::Chessboard,
        columns,
        rows,
        square_m,
    })
}

fn charuco(given: &str, rest: &str, square_m: f64) -> Result<Board, BoardError> {
    let (squares, name) = rest.split_once(':').ok_or_else(|| BoardError::Form {
        given: given.to_owned(),
    })?;
    let (columns, rows) = sides(given, squares)?;
    let dictionary = Dictionary::named(name).ok_or_else(|| BoardError::Dictionary {
        given: given.to_owned(),
        dictionary: name.to_owned(),
        known: Dictionary::names().join(", "),
    })?;
    Ok(Board {
        kind: BoardKind::Charuco {
            dictionary,
            marker_share: MARKER_SHARE,
        },
        columns: columns - 1,
        rows: rows - 1,
        square_m,
    })
}

fn sides(given: &str, text: &str) -> Result<(usize, usize), BoardError> {
    let form = || BoardError::Form {
        given: given.to_owned(),
    };
    let (columns, rows) = text.split_once(['x', 'X']).ok_or_else(form)?;
    let columns: usize = columns.trim().parse().map_err(|_| form())?;
    let rows: usize = rows.trim().parse().map_err(|_| form())?;
    for corners in [columns, rows] {
        if !(3..=40).contains(&corners) {
            return Err(BoardError::Corners {
                given: given.to_owned(),
                corners,
            });
        }
    }
    Ok((columns, rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_count_along_rows() {
        let board = Board::parse("9x6", 0.028).unwrap();
        assert_eq!(board.corners(), 54);
        assert_eq!(board.point_m(10), Vector3::new(0.028, 0.028, 0.0));
        assert!(board.has_one_way_up());
        assert!(!Board::parse("8x6", 0.028).unwrap().has_one_way_up());
    }

    #[test]
    fn a_charuco_board_is_named_by_its_squares() {
        let board = Board::parse("charuco:11x8:4x4_50", 0.03).unwrap();
        assert_eq!((board.columns, board.rows), (10, 7));
        assert!(board.with_marker_m(0.035).is_err());
    }

    #[test]
    fn what_is_no_board_is_refused_with_an_example() {
        for given in ["", "9", "9x", "9x6x3", "axb", "charuco:9x6"] {
            let message = Board::parse(given, 0.028).unwrap_err().to_string();
            assert!(message.contains("9x6"), "{message}");
        }
        assert!(Board::parse("7x7", 0.028).is_err());
        assert!(Board::parse("2x700", 0.028).is_err());
        let mm = Board::parse("9x6", 28.0).unwrap_err().to_string();
        assert!(mm.contains("mm"), "{mm}");
        let unknown = Board::parse("charuco:9x6:9x9_50", 0.028).unwrap_err();
        assert!(unknown.to_string().contains("4x4_50"), "{unknown}");
    }
}
