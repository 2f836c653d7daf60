//! Geometry with the precision that the answers need: `f64` wherever the answer depends on it.

pub mod bvh;
pub mod contour;
pub mod coverage;
pub mod irradiance;
pub mod outline;
mod quadrature;
pub mod shaft;
pub mod surface;
pub mod triangle;
