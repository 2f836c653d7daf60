//! The `penumbra` command.

use std::process::ExitCode;

fn main() -> ExitCode {
    penumbra::cli::main()
}
