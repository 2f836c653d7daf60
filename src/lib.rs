//! Penumbra: soft shadows whose accuracy is a number.
//!
//! The flow is one straight line: a [`scene::Scene`] is loaded, [`receivers::Receivers`] are found per pixel, a technique
//! estimates the visibility of each light from them, and an [`image::Image`] with named channels is written and measured
//! against another by [`metrics`]. The one that everything else is judged by comes from [`mod@reference`].
//!
//! The one quantity that every technique estimates is **visibility** V: the fraction of the light's area seen from a receiver,
//! 0 in the umbra, 1 when lit. Irradiance E (cosine- and distance-weighted, W/m²) is a second quantity with its own name.
//!
//! Units are SI, colours linear Rec. 709. Spaces are named in [`scene`].

pub mod bench;
pub mod cli;
pub mod closed_forms;
pub mod error;
pub mod geometry;
pub mod gpu;
pub mod history;
pub mod image;
pub mod metrics;
pub mod output;
pub mod picture;
pub mod progress;
pub mod receivers;
pub mod reference;
pub mod render;
pub mod sampling;
pub mod scene;
pub mod shading;
pub mod techniques;

pub use error::{Error, Result};
