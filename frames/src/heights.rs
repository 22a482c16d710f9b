//! Heights above the three surfaces that people confuse: ellipsoid, mean sea level, ground.

use serde::{Deserialize, Serialize};
use std::ops::{Add, Sub};

macro_rules! height {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(f64);
        impl $name {
            /// From metres.
            #[must_use]
            pub const fn from_m(metres: f64) -> Self {
                Self(metres)
            }
            /// In metres.
            #[must_use]
            pub const fn m(self) -> f64 {
                self.0
            }
        }
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, "{:.2} m", self.0)
            }
        }
    };
}

height! {
    /// Height above the WGS84 ellipsoid.
    EllipsoidHeight
}
height! {
    /// Altitude above mean sea level (the EGM96 geoid, unless the receiver brought its own).
    MslAltitude
}
height! {
    /// Geoid above ellipsoid: `EllipsoidHeight = MslAltitude + GeoidUndulation`.
    GeoidUndulation
}
height! {
    /// Height above the ground beneath.
    HeightAboveGround
}

impl Add<GeoidUndulation> for MslAltitude {
    type Output = EllipsoidHeight;
    fn add(self, undulation: GeoidUndulation) -> EllipsoidHeight {
        EllipsoidHeight(self.0 + undulation.0)
    }
}
impl Sub<GeoidUndulation> for EllipsoidHeight {
    type Output = MslAltitude;
    fn sub(self, undulation: GeoidUndulation) -> MslAltitude {
        MslAltitude(self.0 - undulation.0)
    }
}
impl Sub<MslAltitude> for EllipsoidHeight {
    type Output = GeoidUndulation;
    fn sub(self, altitude: MslAltitude) -> GeoidUndulation {
        GeoidUndulation(self.0 - altitude.0)
    }
}
impl Sub for EllipsoidHeight {
    type Output = HeightAboveGround;
    /// Height of `self` above a ground whose ellipsoid height is `ground`.
    fn sub(self, ground: EllipsoidHeight) -> HeightAboveGround {
        HeightAboveGround(self.0 - ground.0)
    }
}
impl Add<HeightAboveGround> for EllipsoidHeight {
    type Output = EllipsoidHeight;
    fn add(self, above: HeightAboveGround) -> EllipsoidHeight {
        EllipsoidHeight(self.0 + above.0)
    }
}
