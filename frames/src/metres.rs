//! Plain metres in and out of typed coordinates, for linear algebra inside one frame.

use nalgebra::Vector3;
use sguaba::{Coordinate, Vector};
use uom::si::{f64::Length, length::meter};

/// Components in metres, in the axes of the value's own frame.
pub trait Metres: Sized {
    /// The three components in metres, in the order of the frame's axes.
    fn metres(&self) -> Vector3<f64>;
    /// A value of this frame from three components in metres.
    fn from_metres(metres: Vector3<f64>) -> Self;
}

/// The order of components is the frame's own, which the builders could only state per convention.
macro_rules! typed {
    ($type:ty, $metres:expr) => {{
        let [x, y, z] = <[f64; 3]>::from($metres).map(Length::new::<meter>);
        #[expect(
            deprecated,
            reason = "generic over the frame: no builder serves all conventions"
        )]
        let value = <$type>::from_cartesian(x, y, z);
        value
    }};
}

impl<In> Metres for Coordinate<In> {
    fn metres(&self) -> Vector3<f64> {
        Vector3::from(self.to_cartesian().map(|length| length.get::<meter>()))
    }
    fn from_metres(metres: Vector3<f64>) -> Self {
        typed!(Self, metres)
    }
}

impl<In> Metres for Vector<In> {
    fn metres(&self) -> Vector3<f64> {
        Vector3::from(self.to_cartesian().map(|length| length.get::<meter>()))
    }
    fn from_metres(metres: Vector3<f64>) -> Self {
        typed!(Self, metres)
    }
}
