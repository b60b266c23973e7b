//! The prompt's own parts. It shows itself on a terminal alone, so that they are tested as functions; being compiled
//! here, they need no test binary of the command.

#[path = "../src/commands/sql/prompt/command.rs"]
#[allow(dead_code, reason = "the prompt's, which wants more of it than its tests")]
mod command;
#[path = "../src/commands/sql/script.rs"]
#[allow(dead_code, reason = "the prompt's, which wants more of it than its tests")]
mod script;
#[path = "../src/commands/sql/prompt/words.rs"]
#[allow(dead_code, reason = "the prompt's, which wants more of it than its tests")]
mod words;
#[expect(clippy::module_inception, reason = "the script names its place in the command")]
mod prompt {
    pub(super) use super::command;
}
