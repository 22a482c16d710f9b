//! The board: what is printed on it, and where its corners are.

use emberfix_frames::Vector3;

/// A flat board with a grid of corners; X along its rows, Y along its columns, Z away from the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
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
    #[error("board {given:?}: needed is COLUMNSxROWS of inner corners, such as 9x6")]
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
    /// A board that nothing here can find.
    #[error("board {given:?}: ChArUco boards are not supported; print a chessboard, such as 9x6")]
    Charuco {
        /// What was given.
        given: String,
    },
    /// A size in the wrong unit.
    #[error("square side {square_m} m, allowed is 0.002 to 1 (was it given in mm?)")]
    SquareSide {
        /// Metres.
        square_m: f64,
    },
}

impl Board {
    /// Reads `9x6`, inner corners.
    ///
    /// # Errors
    /// [`BoardError`].
    pub fn parse(given: &str, square_m: f64) -> Result<Self, BoardError> {
        if !(0.002..=1.0).contains(&square_m) {
            return Err(BoardError::SquareSide { square_m });
        }
        if given.starts_with("charuco") {
            return Err(BoardError::Charuco {
                given: given.to_owned(),
            });
        }
        let (columns, rows) = sides(given)?;
        if columns == rows {
            return Err(BoardError::Square {
                given: given.to_owned(),
            });
        }
        Ok(Self {
            columns,
            rows,
            square_m,
        })
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
        (self.columns + self.rows) % 2 == 1
    }
}

fn sides(given: &str) -> Result<(usize, usize), BoardError> {
    let form = || BoardError::Form {
        given: given.to_owned(),
    };
    let (columns, rows) = given.split_once(['x', 'X']).ok_or_else(form)?;
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
    fn a_charuco_board_is_refused_by_name_not_looked_for_in_vain() {
        let refused = Board::parse("charuco:11x8:4x4_50", 0.03).unwrap_err();
        assert!(refused.to_string().contains("not supported"), "{refused}");
    }

    #[test]
    fn what_is_no_board_is_refused_with_an_example() {
        for given in ["", "9", "9x", "9x6x3", "axb"] {
            let message = Board::parse(given, 0.028).unwrap_err().to_string();
            assert!(message.contains("9x6"), "{message}");
        }
        assert!(Board::parse("7x7", 0.028).is_err());
        assert!(Board::parse("2x700", 0.028).is_err());
        let mm = Board::parse("9x6", 28.0).unwrap_err().to_string();
        assert!(mm.contains("mm"), "{mm}");
    }
}
