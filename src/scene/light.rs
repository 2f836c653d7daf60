//! Area lights: their shapes, where their surface is as a receiver sees it, and how they emit.
//!
//! Flat shapes lie in the local XY plane and emit along −Z, as in UsdLux and glTF.

use std::f64::consts::PI;

use glam::{DAffine3, DVec2, DVec3};

/// A light of any shape.
#[derive(Debug, Clone)]
pub struct AreaLight {
    /// Unique within the scene; the layer name in images.
    pub name: String,
    /// Rotation and translation only: lengths of the shape are metres.
    pub scene_from_light: DAffine3,
    /// Its shape and size.
    pub shape: Shape,
    /// How much it emits, linear RGB.
    pub emission: Emission,
    /// Full angle around −Z within which a flat light emits, radians; π is Lambertian. Emission falls off as
    /// `(tan h − tan θ)/(tan h − h)` for `h = spread/2`, which keeps the total power (Cycles' rule).
    pub spread: f64,
    /// A spot's cone about −Z.
    pub cone: Option<Cone>,
    /// Without it the light reaches all that faces it.
    pub casts_shadow: bool,
    /// Names of nodes (with all below them) that this light does not light.
    pub light_exclude: Vec<String>,
    /// Names of nodes (with all below them) that do not block this light.
    pub shadow_exclude: Vec<String>,
    /// The instance whose emissive geometry is this light: it never blocks it.
    pub own_instance: Option<usize>,
}

/// What a light looks like. Lengths in metres, angles in radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A rectangle in the local XY plane, one-sided.
    Rect {
        /// Full width (X) and height (Y).
        size: DVec2,
    },
    /// A disk or an ellipse in the local XY plane, one-sided.
    Disk {
        /// Full axes along X and Y (a circle's diameter, twice).
        size: DVec2,
    },
    /// A sphere around the local origin.
    Sphere {
        /// Its radius; zero acts as a point.
        radius: f64,
        /// Acts as a disk of this radius through the centre that faces the receiver (Blender's soft falloff).
        facing: bool,
    },
    /// A cylinder along local X with dark caps, taken as the length × diameter rectangle that faces the receiver.
    Tube {
        /// Length along X.
        length: f64,
        /// Radius.
        radius: f64,
    },
    /// A disc at infinity towards local +Z (light travels along −Z).
    Sun {
        /// Full angle; zero is a directional light.
        angle: f64,
    },
    /// A point.
    Point,
}

/// How much a light emits, linear RGB; which unit belongs to which shape is fixed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Emission {
    /// Rect, disk, sphere, tube: radiance, W/(m²·sr).
    Radiance(DVec3),
    /// Point (a spot of no radius too): intensity, W/sr.
    Intensity(DVec3),
    /// Sun: irradiance at normal incidence, W/m².
    Irradiance(DVec3),
}

/// A spot's cone: full emission within `inner`, none beyond `outer`, `KHR_lights_punctual`'s falloff between. Angles from
/// the axis to the cone, radians.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cone {
    /// Full emission up to this angle.
    pub inner: f64,
    /// No emission from this angle on.
    pub outer: f64,
}

/// The surface that stands for a light as seen from one receiver: what V is an area fraction of. All in scene space,
/// relative to nothing but the receiver it was made for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Emitter {
    /// Which parameter domain the surface has.
    pub domain: Domain,
    /// From the receiver to the surface's centre (a direction of any length when `distant`).
    pub center: DVec3,
    /// Half axis along u: the surface is `center + u·half_u + v·half_v`.
    pub half_u: DVec3,
    /// Half axis along v.
    pub half_v: DVec3,
    /// Unit normal on the emitting side.
    pub normal: DVec3,
    /// At infinity: only directions count.
    pub distant: bool,
}

/// Parameter domain of an [`Emitter`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Domain {
    /// `u, v` in [−1, 1]².
    Rect,
    /// `u² + v² ≤ 1`.
    Disk,
    /// `u = v = 0` alone.
    Point,
}

impl Shape {
    /// Whether it is seen as a single point or direction.
    pub fn is_point(&self) -> bool {
        match *self {
            Self::Point => true,
            Self::Sphere { radius, .. } => radius == 0.0,
            Self::Sun { angle } => angle == 0.0,
            Self::Rect { .. } | Self::Disk { .. } | Self::Tube { .. } => false,
        }
    }

    /// The name used by files, options and reports.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Rect { .. } => "rect",
            Self::Disk { .. } => "disk",
            Self::Sphere { .. } => "sphere",
            Self::Tube { .. } => "tube",
            Self::Sun { .. } => "sun",
            Self::Point => "point",
        }
    }
}

impl AreaLight {
    /// A white light of radiance, intensity or irradiance 1 with nothing special about it.
    pub fn new(name: impl Into<String>, scene_from_light: DAffine3, shape: Shape) -> Self {
        let emission = match shape {
            Shape::Point => Emission::Intensity(DVec3::ONE),
            Shape::Sun { .. } => Emission::Irradiance(DVec3::ONE),
            _ => Emission::Radiance(DVec3::ONE),
        };
        Self {
            name: name.into(),
            scene_from_light,
            shape,
            emission,
            spread: PI,
            cone: None,
            casts_shadow: true,
            light_exclude: Vec::new(),
            shadow_exclude: Vec::new(),
            own_instance: None,
        }
    }

    /// The direction of the local axis −Z, scene space.
    pub fn axis(&self) -> DVec3 {
        -self.scene_from_light.matrix3.z_axis
    }

    /// The surface that stands for the light at a receiver (scene space), or none where the light's emitting side can't be
    /// seen from there: behind or in the plane of a flat light. Inside a sphere it is the disk that faces nothing: none too.
    ///
    /// - Sphere: the disc of the visible cap's silhouette; with `facing` the disc through the centre.
    /// - Tube: the length × diameter rectangle through the axis, turned to the receiver about the axis.
    /// - Sun: the disc of radius tan(angle/2) at distance 1.
    pub fn emitter(&self, position: DVec3) -> Option<Emitter> {
        let rotation = &self.scene_from_light.matrix3;
        let center = self.scene_from_light.translation - position;
        let flat = |domain, half: DVec2| {
            let normal = -rotation.z_axis;
            // Strictly before the emitting side; the plane itself sees nothing.
            let height = -normal.dot(center);
            let error = 8.0 * f64::EPSILON * (self.scene_from_light.translation.abs() + position.abs()).element_sum();
            (height > error).then(|| Emitter {
                domain,
                center,
                half_u: half.x * rotation.x_axis,
                half_v: half.y * rotation.y_axis,
                normal,
                distant: false,
            })
        };
        match self.shape {
            Shape::Rect { size } => flat(Domain::Rect, 0.5 * size),
            Shape::Disk { size } => flat(Domain::Disk, 0.5 * size),
            Shape::Sphere { radius, facing } => {
                if radius == 0.0 {
                    return Some(point_emitter(center, false));
                }
                let distance = center.length();
                if facing {
                    return (distance > 0.0).then(|| disc_emitter(center, center / distance, radius, false));
                }
                // cos of the cone's half angle, without cancellation for a receiver just outside.
                let squared = (distance - radius) * (distance + radius);
                (squared > 0.0).then(|| {
                    let cos = squared.sqrt() / distance;
                    disc_emitter(center * (cos * cos), center / distance, radius * cos, false)
                })
            }
            Shape::Tube { length, radius } => {
                let axis = rotation.x_axis;
                let across = center - axis.dot(center) * axis;
                let distance = across.length();
                (distance > 0.0).then(|| Emitter {
                    domain: Domain::Rect,
                    center,
                    half_u: 0.5 * length * axis,
                    half_v: radius * (across / distance).cross(axis),
                    normal: -across / distance,
                    distant: false,
                })
            }
            Shape::Sun { angle } => {
                let direction = rotation.z_axis;
                if angle == 0.0 {
                    return Some(point_emitter(direction, true));
                }
                Some(disc_emitter(direction, direction, (0.5 * angle).tan(), true))
            }
            Shape::Point => Some(point_emitter(center, false)),
        }
    }
}

/// A disc around `center` that faces back along `direction`.
fn disc_emitter(center: DVec3, direction: DVec3, radius: f64, distant: bool) -> Emitter {
    let (u, v) = direction.any_orthonormal_pair();
    Emitter { domain: Domain::Disk, center, half_u: radius * u, half_v: radius * v, normal: -direction, distant }
}

/// A single direction or position.
fn point_emitter(center: DVec3, distant: bool) -> Emitter {
    let normal = -center.normalize_or_zero();
    Emitter { domain: Domain::Point, center, half_u: DVec3::ZERO, half_v: DVec3::ZERO, normal, distant }
}

impl Emitter {
    /// From the receiver to the surface at `u, v`.
    pub fn at(&self, uv: DVec2) -> DVec3 {
        self.center + uv.x * self.half_u + uv.y * self.half_v
    }

    /// Bound on the error of each coordinate of [`Emitter::at`] as seen from the receiver that it was made for, at `position`:
    /// a handful of roundings of its terms.
    pub fn position_error(&self, position: DVec3) -> f64 {
        let magnitude = self.center.abs() + self.half_u.abs() + self.half_v.abs() + position.abs();
        8.0 * f64::EPSILON * magnitude.max_element()
    }

    /// The surface's area, m² (at distance 1 for a distant one); zero for a point.
    pub fn area(&self) -> f64 {
        let parallelogram = self.half_u.cross(self.half_v).length();
        match self.domain {
            Domain::Rect => 4.0 * parallelogram,
            Domain::Disk => PI * parallelogram,
            Domain::Point => 0.0,
        }
    }
}

impl Cone {
    /// Emission relative to the axis at an angle whose cosine is given (KHR_lights_punctual, inner and outer cone angles).
    pub fn attenuation(&self, cos_angle: f64) -> f64 {
        let (cos_inner, cos_outer) = (self.inner.cos(), self.outer.cos());
        if cos_angle >= cos_inner {
            return 1.0;
        }
        if cos_angle <= cos_outer {
            return 0.0;
        }
        let linear = (cos_angle - cos_outer) / (cos_inner - cos_outer);
        linear * linear
    }
}
