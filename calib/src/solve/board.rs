//! The board: what is printed on it, and where its corners are.

use super::Dictionary;
use super::dictionary::MARKERS;
use emberfix_frames::Vector3;

/// A board with a grid of corners; X along its rows, Y along its columns, Z away from the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
    /// Inner corners in a row.
    pub columns: usize,
    /// Rows of inner corners.
    pub rows: usize,
    /// Side of a square, metres.
    pub square_m: f64,
    /// The markers in the white squares of a ChArUco board.
    pub markers: Option<Markers>,
}

/// The markers of a ChArUco board, numbered row by row; by them a board is known that is seen in part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Markers {
    /// Side of a marker, its black border included, metres.
    pub side_m: f64,
    /// Which set they are of.
    pub dictionary: Dictionary,
}

/// Why a board's description was refused.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum BoardError {
    /// Not a description.
    #[error(
        "board {given:?}: needed is COLUMNSxROWS of inner corners for a chessboard, such as 9x6, or \
         charuco:COLUMNSxROWS of squares, such as charuco:9x6 or charuco:11x8:5x5_100"
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
    /// A dictionary that is not here.
    #[error(
        "board {given:?}: markers {name:?} are unknown, known are 4x4, 5x5, 6x6 and 7x7 with _50, _100 or \
         _250"
    )]
    Dictionary {
        /// What was given.
        given: String,
        /// The name.
        name: String,
    },
    /// More white squares than there are markers.
    #[error("board {given:?} has {markers} white squares, allowed is {MARKERS}")]
    Markers {
        /// What was given.
        given: String,
        /// White squares.
        markers: usize,
    },
    /// A ChArUco board of which the markers' size was not given.
    #[error("board {given:?}: --marker-mm is needed, the side of a marker with its black border")]
    NoMarkerSide {
        /// What was given.
        given: String,
    },
    /// Markers that do not fit their squares.
    #[error(
        "marker side {marker_mm} mm in squares of {square_mm} mm: allowed is 0.4 to 0.95 of a square"
    )]
    MarkerSide {
        /// Side of a marker.
        marker_mm: f64,
        /// Side of a square.
        square_mm: f64,
    },
    /// A size in the wrong unit.
    #[error("square side {square_m} m, allowed is 0.002 to 1 (was it given in mm?)")]
    SquareSide {
        /// Metres.
        square_m: f64,
    },
}

impl Board {
    /// A chessboard, by its inner corners.
    #[must_use]
    pub const fn chess(columns: usize, rows: usize, square_m: f64) -> Self {
        Self {
            columns,
            rows,
            square_m,
            markers: None,
        }
    }

    /// Reads `9x6`, inner corners of a chessboard; or `charuco:9x6`, squares of a ChArUco board (as those
    /// who print them count), with the set of its markers if they are not 4x4: `charuco:9x6:5x5_100`.
    ///
    /// # Errors
    /// [`BoardError`].
    pub fn parse(given: &str, square_m: f64, marker_m: Option<f64>) -> Result<Self, BoardError> {
        if !(0.002..=1.0).contains(&square_m) {
            return Err(BoardError::SquareSide { square_m });
        }
        match given.strip_prefix("charuco:") {
            Some(rest) => charuco(given, rest, square_m, marker_m),
            None => chess(given, square_m),
        }
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

    /// The middle of its corners, metres.
    #[must_use]
    pub fn middle_m(&self) -> Vector3<f64> {
        let (columns, rows) = (self.columns as f64 - 1.0, self.rows as f64 - 1.0);
        Vector3::new(columns, rows, 0.0) * (0.5 * self.square_m)
    }

    /// Whether the corners can be numbered in one way only: by markers, or because half a turn changes
    /// the pattern.
    #[must_use]
    pub fn has_one_way_up(&self) -> bool {
        self.markers.is_some() || (self.columns + self.rows) % 2 == 1
    }

    /// For people.
    #[must_use]
    pub fn words(&self) -> String {
        let square_mm = 1e3 * self.square_m;
        match self.markers {
            None => format!(
                "chessboard of {}x{} inner corners, squares of {square_mm} mm",
                self.columns, self.rows
            ),
            Some(markers) => format!(
                "ChArUco board of {}x{} squares of {square_mm} mm, {side}x{side} markers of {} mm",
                self.columns + 1,
                self.rows + 1,
                1e3 * markers.side_m,
                side = markers.dictionary.side_bits(),
            ),
        }
    }
}

fn chess(given: &str, square_m: f64) -> Result<Board, BoardError> {
    let (columns, rows) = sides(given, given, 0)?;
    if columns == rows {
        return Err(BoardError::Square {
            given: given.to_owned(),
        });
    }
    Ok(Board::chess(columns, rows, square_m))
}

fn charuco(
    given: &str,
    rest: &str,
    square_m: f64,
    marker_m: Option<f64>,
) -> Result<Board, BoardError> {
    let given_again = || given.to_owned();
    let (size, name) = rest.split_once(':').unwrap_or((rest, "4x4"));
    let (columns, rows) = sides(given, size, 1)?;
    let dictionary = Dictionary::parse(name).ok_or_else(|| BoardError::Dictionary {
        given: given_again(),
        name: name.to_owned(),
    })?;
    let markers = (columns + 1) * (rows + 1) / 2;
    if markers > MARKERS {
        return Err(BoardError::Markers {
            given: given_again(),
            markers,
        });
    }
    let side_m = marker_m.ok_or_else(|| BoardError::NoMarkerSide {
        given: given_again(),
    })?;
    if !(0.4..=0.95).contains(&(side_m / square_m)) {
        return Err(BoardError::MarkerSide {
            marker_mm: 1e3 * side_m,
            square_mm: 1e3 * square_m,
        });
    }
    Ok(Board {
        markers: Some(Markers { side_m, dictionary }),
        ..Board::chess(columns, rows, square_m)
    })
}

/// Inner corners along both sides; `less` of what is counted.
fn sides(given: &str, size: &str, less: usize) -> Result<(usize, usize), BoardError> {
    let form = || BoardError::Form {
        given: given.to_owned(),
    };
    let (columns, rows) = size.split_once(['x', 'X']).ok_or_else(form)?;
    let columns: usize = columns.trim().parse().map_err(|_| form())?;
    let rows: usize = rows.trim().parse().map_err(|_| form())?;
    let (columns, rows) = (columns.saturating_sub(less), rows.saturating_sub(less));
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

    fn parse(given: &str) -> Result<Board, BoardError> {
        Board::parse(given, 0.028, Some(0.021))
    }

    #[test]
    fn corners_count_along_rows() {
        let board = parse("9x6").unwrap();
        assert_eq!(board.corners(), 54);
        assert_eq!(board.point_m(10), Vector3::new(0.028, 0.028, 0.0));
        assert!(board.has_one_way_up());
        assert!(!parse("8x6").unwrap().has_one_way_up());
    }

    #[test]
    fn a_charuco_board_counts_squares_and_names_its_markers() {
        let board = parse("charuco:11x8:5x5_100").unwrap();
        assert_eq!((board.columns, board.rows), (10, 7));
        let markers = board.markers.unwrap();
        assert_eq!(markers.dictionary, Dictionary::Five);
        assert!(
            board
                .words()
                .contains("11x8 squares of 28 mm, 5x5 markers of 21 mm"),
            "{}",
            board.words()
        );
        let four = parse("charuco:9x6").unwrap().markers.unwrap();
        assert_eq!(four.dictionary, Dictionary::Four);
    }

    #[test]
    fn what_is_no_board_is_refused_with_an_example() {
        for given in ["", "9", "9x", "9x6x3", "axb", "charuco:", "charuco:9"] {
            let message = parse(given).unwrap_err().to_string();
            assert!(message.contains("9x6"), "{message}");
        }
        for given in ["7x7", "2x700", "charuco:3x9", "charuco:30x30"] {
            assert!(parse(given).is_err(), "{given}");
        }
        let unknown = parse("charuco:9x6:apriltag").unwrap_err().to_string();
        assert!(unknown.contains("5x5"), "{unknown}");
        let mm = Board::parse("9x6", 28.0, None).unwrap_err().to_string();
        assert!(mm.contains("mm"), "{mm}");
        let no_side = Board::parse("charuco:9x6", 0.028, None).unwrap_err();
        assert!(no_side.to_string().contains("--marker-mm"), "{no_side}");
        let too_large = Board::parse("charuco:9x6", 0.028, Some(0.028)).unwrap_err();
        assert!(too_large.to_string().contains("0.95"), "{too_large}");
    }
}
