//! Every parameter of every technique, at both ends of its range, at each of its choices, and beyond.

use std::sync::LazyLock;

use penumbra::Error;
use penumbra::progress::Progress;
use penumbra::render::{Request, render};
use penumbra::scene::Scene;
use penumbra::scene::procedural::build;
use penumbra::techniques::{ALL, Context, Entry, Parameter, parse_settings};

/// One adapter for all.
static CONTEXT: LazyLock<Context> = LazyLock::new(Context::default);

/// Ends above it are costs, not cases: what renders with so much is tried by `ends_that_cost`.
const DEAR: f64 = 2048.0;

/// Renders a small image; settings that cannot be are refused in one line that names the technique, its parameter or the light.
fn try_out(scene: &Scene, entry: &Entry, settings: &str) {
    let what = format!("{} {settings}", entry.name);
    let refused = |error: &Error| {
        let text = error.to_string();
        let is_clear = matches!(error, Error::Usage { .. } | Error::Gpu(_)) && text.lines().count() == 1;
        assert!(is_clear && text.contains(entry.name), "{what}: {text}");
    };
    let technique = match (entry.build)(&CONTEXT, &parse_settings(settings).expect("settings")) {
        Ok(technique) => technique,
        Err(error) => return refused(&error),
    };
    let request = Request { size: [20, 15], irradiance: true, shaded: None, antialiasing: 1, verify: None };
    match render(scene, &scene.cameras[0], technique.as_ref(), &request, &Progress::default()) {
        Err(error) => refused(&error),
        Ok(rendering) => {
            for image in &rendering.lights {
                assert!(image.visibility.iter().all(|v| (0.0..=1.0).contains(v)), "{what}");
                assert!(image.irradiance.iter().flatten().all(|e| e.is_finite() && *e >= 0.0), "{what}");
            }
        }
    }
}

/// Settings that keep what is tried cheap, but for the parameter that is.
fn cheap(entry: &Entry, but: &str) -> String {
    let known = [("map_size", "32"), ("frames", "4"), ("samples", "4"), ("max_maps", "30")];
    let has = |name: &str| entry.parameters().iter().any(|parameter| parameter.name == name);
    let settings = known.iter().filter(|(name, _)| *name != but && has(name));
    settings.map(|(name, value)| format!("{name}={value} ")).collect()
}

/// The ends of a parameter's range.
fn ends(parameter: &Parameter) -> impl Iterator<Item = f64> + use<> {
    [parameter.minimum, parameter.maximum].into_iter().flatten()
}

#[test]
fn both_ends_and_every_choice_of_every_parameter_render_or_are_refused_in_one_line() {
    let scene = build("contact").expect("builds").scene;
    let mut tried = 0;
    for entry in ALL {
        for parameter in entry.parameters() {
            let name = &parameter.name;
            let mut values: Vec<String> = parameter.choices.iter().map(|(choice, _)| choice.clone()).collect();
            if parameter.default.is_boolean() {
                values.extend(["true".into(), "false".into()]);
            }
            values.extend(ends(&parameter).filter(|end| *end <= DEAR).map(|end| end.to_string()));
            for value in values {
                try_out(&scene, entry, &format!("{}{name}={value}", cheap(entry, name)));
                tried += 1;
            }
        }
    }
    assert!(tried > 150, "{tried}");
}

#[test]
fn what_is_beyond_a_range_is_refused_and_the_parameter_named() {
    for entry in ALL {
        for parameter in entry.parameters() {
            let beyond = [parameter.minimum.map(|end| end - 1.0), parameter.maximum.map(|end| 2.0 * end + 1.0)];
            for value in beyond.into_iter().flatten() {
                let settings = format!("{}={value}", parameter.name);
                let error = (entry.build)(&CONTEXT, &parse_settings(&settings).expect("settings"));
                let text = error.expect_err(&format!("{} {settings}", entry.name)).to_string();
                assert!(text.contains(&parameter.name) && text.lines().count() == 1, "{}: {text}", entry.name);
            }
        }
    }
}

#[test]
#[ignore = "maps of gigabytes, a million frames: scripts/test --full"]
fn ends_that_cost() {
    let scene = build("square").expect("builds").scene;
    for entry in ALL {
        for parameter in entry.parameters() {
            for end in ends(&parameter).filter(|end| *end > DEAR) {
                try_out(&scene, entry, &format!("{}{}={end}", cheap(entry, &parameter.name), parameter.name));
            }
        }
    }
}
