//! `penumbra list`.

use std::fmt::Write;

use clap::Args;
use serde::Serialize;

use super::{print, print_json};
use crate::scene::procedural;
use crate::techniques::{ALL, Needs, Parameter};

/// Options of `list`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Prints JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Listed {
    name: &'static str,
    paper: &'static str,
    summary: &'static str,
    needs: Needs,
    presets: Vec<Preset>,
    parameters: Vec<Parameter>,
}

/// Settings that a technique has by name, beside its defaults.
#[derive(Debug, Serialize)]
struct Preset {
    name: &'static str,
    settings: &'static str,
}

/// Runs the command.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let techniques: Vec<Listed> = ALL
        .iter()
        .map(|entry| Listed {
            name: entry.name,
            paper: entry.paper,
            summary: entry.summary,
            needs: entry.needs,
            presets: entry.presets.iter().map(|&(name, settings)| Preset { name, settings }).collect(),
            parameters: entry.parameters(),
        })
        .collect();
    let scenes: Vec<ListedScene> = procedural::ENTRIES.iter().map(ListedScene::new).collect();
    let common: Vec<SceneParameter> = procedural::COMMON_PARAMETERS.iter().map(SceneParameter::new).collect();
    if arguments.json {
        return print_json(&serde_json::json!({
            "techniques": techniques,
            "procedural_scenes": scenes,
            "procedural_scene_parameters": common,
        }));
    }
    let mut text = String::from("Techniques (penumbra render SCENE --technique NAME --set KEY=VALUE)\n\n");
    for technique in &techniques {
        describe(&mut text, technique).expect("a string takes all");
    }
    text += "\nProcedural scenes (procedural:NAME?key=value&key=value)\n\n";
    for scene in &scenes {
        writeln!(text, "{} - {}", scene.name, scene.about).expect("a string takes all");
        describe_parameters(&mut text, &scene.parameters).expect("a string takes all");
    }
    text += "all of them\n";
    describe_parameters(&mut text, &common).expect("a string takes all");
    print(&text)
}

/// A procedural scene.
#[derive(Debug, Serialize)]
struct ListedScene {
    name: &'static str,
    about: &'static str,
    parameters: Vec<SceneParameter>,
}

#[derive(Debug, Serialize)]
struct SceneParameter {
    name: &'static str,
    meaning: &'static str,
    default: String,
    range: String,
}

impl ListedScene {
    fn new(entry: &procedural::Entry) -> Self {
        let parameters = entry.parameters.iter().map(SceneParameter::new).collect();
        Self { name: entry.name, about: entry.about, parameters }
    }
}

impl SceneParameter {
    fn new(parameter: &procedural::Parameter) -> Self {
        Self {
            name: parameter.name,
            meaning: parameter.meaning,
            default: parameter.kind.default_text(),
            range: parameter.kind.to_string(),
        }
    }
}

fn describe_parameters(text: &mut String, parameters: &[SceneParameter]) -> std::fmt::Result {
    for SceneParameter { name, meaning, default, range } in parameters {
        writeln!(text, "    {name}={default}: {meaning} ({range})")?;
    }
    Ok(())
}

fn describe(text: &mut String, technique: &Listed) -> std::fmt::Result {
    writeln!(text, "{} - {}", technique.name, technique.summary)?;
    let runs_on = match technique.needs {
        Needs::Cpu => "the processor",
        Needs::Gpu => "a GPU",
    };
    writeln!(text, "  {}; runs on {runs_on}", technique.paper)?;
    for Preset { name, settings } in &technique.presets {
        writeln!(text, "    --preset {name}: {settings}")?;
    }
    for parameter in &technique.parameters {
        let range = match (parameter.minimum, parameter.maximum) {
            (Some(minimum), Some(maximum)) => format!(", {minimum} to {maximum}"),
            (Some(minimum), None) => format!(", from {minimum}"),
            _ => String::new(),
        };
        writeln!(text, "    --set {}={}{range}", parameter.name, plain(&parameter.default))?;
        writeln!(text, "        {}", parameter.meaning)?;
        for (choice, meaning) in &parameter.choices {
            writeln!(text, "        {choice}: {meaning}")?;
        }
    }
    Ok(())
}

/// A value as `--set` takes it.
fn plain(value: &serde_json::Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}
