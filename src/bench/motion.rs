//! Where the points of surfaces that a frame sees were in the frame before.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::receivers::{Receiver, Receivers};
use crate::scene::camera::Projection;
use crate::scene::{Camera, Scene};

/// What a frame saw, and from where.
#[derive(Debug, Clone, Copy)]
pub struct Seen<'a> {
    /// Posed at the frame's time.
    pub scene: &'a Scene,
    /// The frame's.
    pub camera: &'a Camera,
    /// At pixel centres.
    pub receivers: &'a Receivers,
}

/// For each pixel, the one of the frame before that showed the same point of the surface: what moves with an instance, or bends
/// with its mesh, is followed. None where that frame did not see it.
pub fn came_from(now: Seen, before: Seen) -> Vec<Option<u32>> {
    let pixels = &now.receivers.pixels;
    pixels.par_iter().map(|pixel| pixel.as_ref().and_then(|receiver| origin(receiver, before))).collect()
}

fn origin(receiver: &Receiver, before: Seen) -> Option<u32> {
    let size = before.receivers.size;
    let point = place(receiver, before.scene)?;
    let (at_px, depth) = project(before.camera, point, size)?;
    let [x, y] = at_px.floor().to_array();
    if !(0.0..f64::from(size[0])).contains(&x) || !(0.0..f64::from(size[1])).contains(&y) {
        return None;
    }
    let index = y as u32 * size[0] + x as u32;
    let seen = before.receivers.pixels[index as usize].as_ref()?;
    // The pixel's own point lies up to half a pixel aside, on the same surface: a pixel's footprint off its plane is another
    // part of the instance, in front of the one that is looked for.
    let off_plane = (point - seen.position).dot(seen.normal).abs();
    let same = seen.instance == receiver.instance && off_plane <= before.camera.pixel_footprint(depth, size);
    same.then_some(index)
}

/// Where a receiver's point of its mesh is in another pose of the scene, scene space.
fn place(receiver: &Receiver, scene: &Scene) -> Option<DVec3> {
    let instance = scene.instances.get(receiver.instance as usize)?;
    let mesh = &scene.meshes[instance.mesh];
    let corners = mesh.triangles.get(receiver.triangle as usize)?.map(|i| mesh.positions[i as usize].as_dvec3());
    let [u, v] = receiver.barycentric.map(f64::from);
    Some(instance.scene_from_mesh.transform_point3((1.0 - u - v) * corners[0] + u * corners[1] + v * corners[2]))
}

/// The image position and depth of a point in scene space; none behind the camera. The inverse of [`Camera::ray`].
fn project(camera: &Camera, point: DVec3, size: [u32; 2]) -> Option<(DVec2, f64)> {
    let point_camera = camera.scene_from_camera.inverse().transform_point3(point);
    let depth = -point_camera.z;
    let half_height = match camera.projection {
        Projection::Perspective { fov_y } => (0.5 * fov_y).tan() * depth,
        Projection::Orthographic { half_height } => half_height,
    };
    let [width, height] = size.map(f64::from);
    let [x, y] = [point_camera.x / half_height, point_camera.y / half_height];
    (depth > 0.0).then(|| (0.5 * DVec2::new(x * height + width, height - y * height), depth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::bvh::SceneBvh;
    use crate::progress::Progress;
    use crate::scene::procedural;

    const SIZE: [u32; 2] = [24, 16];

    fn receivers(scene: &Scene, camera: &Camera) -> Receivers {
        let mut bvh = SceneBvh::new(scene);
        bvh.add(|_| true);
        Receivers::find(&bvh, camera, SIZE, DVec2::splat(0.5), &Progress::default()).expect("not cancelled")
    }

    #[test]
    fn projection_undoes_the_camera_ray() {
        for projection in [Projection::Perspective { fov_y: 0.8 }, Projection::Orthographic { half_height: 1.5 }] {
            let bounds = procedural::load("procedural:demo").expect("a scene").bounds();
            let camera = Camera { projection, ..Camera::framing(&bounds, 1.5) };
            let at_px = DVec2::new(3.25, 12.75);
            let ray = camera.ray(at_px, SIZE);
            let (found, depth) = project(&camera, ray.origin + 7.0 * ray.direction, SIZE).expect("in front");
            // Some twenty roundings of numbers below 100.
            assert!((found - at_px).length() < 1e-12 && (depth - 7.0).abs() < 1e-12, "{found} {depth}");
            assert!(project(&camera, ray.origin - 7.0 * ray.direction, SIZE).is_none());
        }
    }

    #[test]
    fn where_nothing_moves_each_pixel_comes_from_itself() {
        let scene = procedural::load("procedural:demo").expect("a scene");
        let camera = &scene.cameras[0];
        let receivers = receivers(&scene, camera);
        let seen = Seen { scene: &scene, camera, receivers: &receivers };
        for (i, (found, pixel)) in came_from(seen, seen).into_iter().zip(&receivers.pixels).enumerate() {
            assert_eq!(found, pixel.as_ref().map(|_| i as u32));
        }
    }

    #[test]
    fn a_camera_that_moves_by_a_pixel_moves_all_pixels_by_one() {
        // Looking straight down on a floor with a square above it, without perspective.
        let scene = procedural::load("procedural:square").expect("a scene");
        let before = &scene.cameras[0];
        let Projection::Orthographic { half_height } = before.projection else {
            panic!("expected an orthographic view")
        };
        let pixel = 2.0 * half_height / f64::from(SIZE[1]);
        let mut now = before.clone();
        now.scene_from_camera.translation += now.scene_from_camera.transform_vector3(DVec3::X * pixel);
        let [seen_before, seen_now] = [receivers(&scene, before), receivers(&scene, &now)];
        let found = came_from(
            Seen { scene: &scene, camera: &now, receivers: &seen_now },
            Seen { scene: &scene, camera: before, receivers: &seen_before },
        );
        for (i, found) in found.into_iter().enumerate() {
            let x = i as u32 % SIZE[0];
            // The floor ends somewhere: what is not covered comes from nowhere.
            let expected = (x + 1 < SIZE[0] && seen_now.pixels[i].is_some()).then_some(i as u32 + 1);
            assert_eq!(found, expected, "pixel {i}");
        }
    }

    #[test]
    fn what_an_instance_hid_comes_from_nowhere() {
        let scene = procedural::load("procedural:contact").expect("a scene");
        let camera = &scene.cameras[0];
        let before = receivers(&scene, camera);
        // The box on the floor goes away, out of the view.
        let highest = before.pixels.iter().flatten().max_by(|a, b| a.position.y.total_cmp(&b.position.y));
        let hider = highest.expect("a receiver").instance;
        let mut moved = scene.clone();
        moved.instances[hider as usize].scene_from_mesh.translation.y += 100.0;
        let now = receivers(&moved, camera);
        let found = came_from(
            Seen { scene: &moved, camera, receivers: &now },
            Seen { scene: &scene, camera, receivers: &before },
        );
        let mut hidden = 0;
        for (i, found) in found.into_iter().enumerate() {
            let was_hidden = before.pixels[i].as_ref().is_some_and(|receiver| receiver.instance == hider);
            assert_eq!(found.is_none(), was_hidden || now.pixels[i].is_none(), "pixel {i}");
            hidden += usize::from(was_hidden && now.pixels[i].is_some());
        }
        assert!(hidden > 0, "the box is in view");
    }

    #[test]
    fn points_are_followed_with_what_they_are_on() {
        let scene = procedural::load("procedural:contact").expect("a scene");
        let camera = &scene.cameras[0];
        let before = receivers(&scene, camera);
        let highest = before.pixels.iter().flatten().max_by(|a, b| a.position.y.total_cmp(&b.position.y));
        let mover = highest.expect("a receiver").instance as usize;
        // Towards the left in the image, by a few pixels at the box's distance.
        let step = camera.scene_from_camera.transform_vector3(DVec3::NEG_X)
            * 3.0
            * camera.pixel_footprint(highest.expect("a receiver").depth, SIZE);
        let mut moved = scene.clone();
        moved.instances[mover].scene_from_mesh.translation += step;
        let now = receivers(&moved, camera);
        let found = came_from(
            Seen { scene: &moved, camera, receivers: &now },
            Seen { scene: &scene, camera, receivers: &before },
        );
        let on_box = |pixel: &Option<Receiver>| pixel.as_ref().is_some_and(|at| at.instance as usize == mover);
        let pairs: Vec<(usize, usize)> = (0..found.len())
            .filter(|&i| on_box(&now.pixels[i]))
            .filter_map(|i| found[i].map(|from| (i, from as usize)))
            .collect();
        assert!(!pairs.is_empty());
        for (i, from) in pairs {
            let [at, was] = [&now.pixels[i], &before.pixels[from]].map(|pixel| pixel.as_ref().expect("on the box"));
            // The pixel's own point lies half a pixel's diagonal aside at most, and the plane a pixel away: along the surface
            // (√½ + 1) footprints over the cosine of its slant, and less than as much again for the perspective.
            let apart = (at.position - step - was.position).length();
            let slant = camera.scene_from_camera.z_axis.dot(was.normal).abs();
            let footprint = camera.pixel_footprint(at.depth.max(was.depth), SIZE);
            assert!(apart <= 3.0 * footprint / slant, "pixel {i}: {apart}");
        }
    }
}
