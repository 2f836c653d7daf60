//! Geometry with the precision that the answers need: `f64` wherever the answer depends on it.

pub mod bvh;
pub mod contour;
pub mod irradiance;
mod quadrature;
pub mod shaft;
pub mod triangle;
