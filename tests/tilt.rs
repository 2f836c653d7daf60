//! `procedural:tilt`: how much of the view is penumbra, by the receiver's tilt and the camera's distance.

mod common;

use common::*;
use glam::DVec3;
use penumbra::progress::Progress;
use penumbra::render::{Rendering, Request, render};
use penumbra::sampling::Pattern;
use penumbra::scene::procedural::{Procedural, build};

fn tilt(query: &str, size: [u32; 2]) -> (Procedural, Rendering) {
    let procedural = build(&format!("procedural:tilt?{query}")).expect("builds");
    let request = Request { size, irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let scene = &procedural.scene;
    let technique = rays(Pattern::Grid, 64);
    let rendering = render(scene, &scene.cameras[0], &technique, &request, &Progress::default()).expect("renders");
    (procedural, rendering)
}

/// Share of the pixels whose V is neither 0 nor 1. The edge is along the image's rows, so that a narrow image serves: from no
/// tilt to 20° the penumbra grows by 6 %, of some 60 rows.
fn penumbra_share(query: &str) -> f64 {
    let (_, rendering) = tilt(query, [4, 600]);
    let visibility = &rendering.lights[0].visibility;
    visibility.iter().filter(|&&v| 0.0 < v && v < 1.0).count() as f64 / visibility.len() as f64
}

#[test]
fn the_penumbra_grows_with_the_tilt() {
    for shape in ["rect", "disk", "sphere", "tube", "sun"] {
        let shares = [0, 20, 40, 60, 80].map(|angle| penumbra_share(&format!("angle={angle}&shape={shape}")));
        assert!(shares.is_sorted_by(|less, more| less < more), "{shape}: {shares:?}");
        assert!(shares[0] > 0.05 && shares[4] > 4.0 * shares[0], "{shape}: {shares:?}");
    }
}

#[test]
fn the_penumbra_in_view_shrinks_with_the_distance() {
    for angle in [0, 60] {
        let shares =
            [0.05, 0.5, 1.0, 2.0, 4.0].map(|distance| penumbra_share(&format!("angle={angle}&distance={distance}")));
        assert!(shares.is_sorted_by(|near, far| near > far), "{angle}: {shares:?}");
        // Near, it is all that is seen.
        assert_eq!(shares[0], 1.0);
    }
}

#[test]
fn the_penumbra_ends_where_the_lines_over_the_edge_meet_the_receiver() {
    // Light of 2·0.25 m at 5 m, edge at 2 m: a line from the light's end falls by 3 m on its 0.25 m to the edge. On a receiver
    // that falls by tan a metre, it goes on for t times that until (2 − 3·t) = −(0.25·t)·tan, and mirrored for the other end.
    for degrees in [0f64, 20.0, 40.0, 60.0, 80.0] {
        let tan = degrees.to_radians().tan();
        let truth = build(&format!("tilt?angle={degrees}")).expect("builds").truth.expect("a truth");
        let v = |x: f64| truth.visibility(DVec3::new(x, -x * tan, 0.3));
        let (lit, dark) = (0.25 * 2.0 / (3.0 - 0.25 * tan), -0.25 * 2.0 / (3.0 + 0.25 * tan));
        for inside in [0.999, 0.5, 0.01] {
            assert!(v(inside * lit) < 1.0 && v(inside * dark) > 0.0 && v(inside * lit) > v(inside * dark));
        }
        assert_eq!((v(1.001 * lit), v(1.001 * dark)), (1.0, 0.0), "{degrees}");
    }
}

#[test]
fn truth_holds_on_the_tilted_receiver() {
    for shape in ["rect", "disk", "sphere", "tube", "sun", "point"] {
        for angle in [0, 35, 80] {
            let (Procedural { scene, truth }, rendering) =
                tilt(&format!("angle={angle}&shape={shape}&distance=0.7"), [96, 72]);
            let truth = truth.expect("a truth");
            let mut seen = 0;
            for (receiver, &v) in rendering.receivers.pixels.iter().zip(&rendering.lights[0].visibility) {
                let Some(receiver) = receiver else { continue };
                let expected = truth.visibility(receiver.position + scene.origin_world);
                // An edge along a row of 8 x 8 cells takes one row more or less; the map of the square onto a disk bends it by
                // up to π/2 rows.
                let bound = if shape == "point" { 0.0 } else { 0.5 * std::f64::consts::PI / 8.0 };
                assert!((f64::from(v) - expected).abs() <= bound + 1e-6, "{shape} {angle}: {v} {expected}");
                seen += usize::from(0.0 < expected && expected < 1.0);
            }
            assert!(seen > 100 || shape == "point", "{shape} {angle}: {seen}");
        }
    }
}
