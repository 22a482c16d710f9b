//! Places on the Earth: degrees to ECEF, and the tangent plane at a place.

use crate::{EllipsoidHeight, Metres};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use sguaba::math::{RigidBodyTransform, Rotation};
use sguaba::systems::{Ecef, EnuLike, Wgs84};
use sguaba::{Coordinate, CoordinateSystem};
use uom::si::{angle::degree, f64::Angle, f64::Length, length::meter};

/// Why a place was refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PlaceError {
    /// Latitude outside -90..90 or not a number.
    #[error("latitude {deg} is outside -90 to 90 degrees")]
    Latitude {
        /// What was given, in degrees.
        deg: f64,
    },
    /// Longitude outside -360..360 or not a number.
    #[error("longitude {deg} is outside -360 to 360 degrees")]
    Longitude {
        /// What was given, in degrees.
        deg: f64,
    },
    /// Height that no aircraft or fire has.
    #[error("ellipsoid height {m} m is outside -11000 to 100000 m")]
    Height {
        /// What was given, in metres.
        m: f64,
    },
}

/// A checked place from degrees and ellipsoid height; the longitude comes out in -180..180.
///
/// # Errors
/// [`PlaceError`] with the offending value.
pub fn place_from_degrees(
    latitude_deg: f64,
    longitude_deg: f64,
    height: EllipsoidHeight,
) -> Result<Wgs84, PlaceError> {
    if !(-90.0..=90.0).contains(&latitude_deg) {
        return Err(PlaceError::Latitude { deg: latitude_deg });
    }
    if !(-360.0..=360.0).contains(&longitude_deg) {
        return Err(PlaceError::Longitude { deg: longitude_deg });
    }
    if !(-11_000.0..=100_000.0).contains(&height.m()) {
        return Err(PlaceError::Height { m: height.m() });
    }
    let wrapped = wrap_longitude(longitude_deg);
    Wgs84::builder()
        .latitude(Angle::new::<degree>(latitude_deg))
        .map(|place| place.longitude(Angle::new::<degree>(wrapped)))
        .map(|place| place.altitude(Length::new::<meter>(height.m())).build())
        .ok_or(PlaceError::Latitude { deg: latitude_deg })
}

/// The place of an ECEF point; `None` where no aircraft or fire can be (below -10 km, above 50 km,
/// or not a number), which is also where the conversion would not be exact.
#[must_use]
pub fn place_from_ecef(point: &Coordinate<Ecef>) -> Option<Wgs84> {
    let finite = point.metres().iter().all(|component| component.is_finite());
    (finite && point.is_in_fast_wgs84_range()).then(|| point.to_wgs84())
}

fn wrap_longitude(longitude_deg: f64) -> f64 {
    if (-180.0..=180.0).contains(&longitude_deg) {
        longitude_deg
    } else {
        (longitude_deg + 180.0).rem_euclid(360.0) - 180.0
    }
}

/// What a [`Wgs84`] place is made of, in our units.
pub trait Wgs84Parts {
    /// Geodetic latitude in degrees, north positive.
    fn latitude_deg(&self) -> f64;
    /// Longitude in degrees, east positive, -180 to 180.
    fn longitude_deg(&self) -> f64;
    /// Height above the ellipsoid.
    fn height(&self) -> EllipsoidHeight;
    /// The same latitude and longitude at another height.
    #[must_use]
    fn at_height(&self, height: EllipsoidHeight) -> Self;
}

impl Wgs84Parts for Wgs84 {
    fn latitude_deg(&self) -> f64 {
        self.latitude().get::<degree>()
    }
    fn longitude_deg(&self) -> f64 {
        wrap_longitude(self.longitude().get::<degree>())
    }
    fn height(&self) -> EllipsoidHeight {
        EllipsoidHeight::from_m(self.altitude().get::<meter>())
    }
    fn at_height(&self, height: EllipsoidHeight) -> Self {
        self.to_builder()
            .altitude(Length::new::<meter>(height.m()))
            .build()
    }
}

/// ECEF to the tangent plane whose origin is `origin`.
///
/// Naming `Enu` states which plane it is: one shutter event's or the mission's.
#[must_use]
pub fn enu_from_ecef<Enu>(origin: &Wgs84) -> RigidBodyTransform<Ecef, Enu>
where
    Enu: CoordinateSystem<Convention = EnuLike>,
{
    #[expect(
        unsafe_code,
        reason = "the plane of `Enu` is DEFINED as the one at `origin`"
    )]
    // SAFETY: both tangent-plane systems of this crate take their origin from the value that the
    // caller holds for that plane; there is no other definition for it to disagree with.
    unsafe {
        RigidBodyTransform::ecef_to_enu_at(origin)
    }
}

/// The tangent plane at `origin` to ECEF (P3 eq. 16, with the 4x4-times-3 product of the printed
/// form mended: a rotation, then a translation).
#[must_use]
pub fn ecef_from_enu<Enu>(origin: &Wgs84) -> RigidBodyTransform<Enu, Ecef>
where
    Enu: CoordinateSystem<Convention = EnuLike>,
{
    enu_from_ecef(origin).inverse()
}

/// East, north, up in metres from `origin` to `place`, in the tangent plane at `origin`.
#[must_use]
pub fn enu_offset(origin: &Wgs84, place: &Wgs84) -> Vector3<f64> {
    enu_from_ecef::<crate::VehicleEnu>(origin)
        .transform(Coordinate::<Ecef>::from_wgs84(place))
        .metres()
}

/// The 3x3 matrix that takes `From` components to `To` components.
#[must_use]
pub fn rotation_matrix<From, To>(rotation: &Rotation<From, To>) -> Matrix3<f64> {
    let (w, i, j, k) = rotation.to_quaternion();
    UnitQuaternion::new_normalize(Quaternion::new(w, i, j, k))
        .to_rotation_matrix()
        .into_inner()
}
