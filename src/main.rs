//! The `emberfix` program: parse arguments, wire, exit.

use std::process::ExitCode;

fn main() -> ExitCode {
    emberfix::cli::main()
}
