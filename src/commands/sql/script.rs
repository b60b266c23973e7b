//! Lines of the prompt or of a script: each is a command, or ends statements, or continues one.

use echolake_query::{is_blank_statement, split_statement};

use super::prompt::command::{PromptCommand, parse_command};

/// The statement or command that a line completes.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum ScriptStep {
    /// A command, or what is wrong with it.
    Command(Result<PromptCommand, String>),
    /// A statement without its semicolon. Its first line has blanks for the text before it.
    Statement {
        /// The text.
        sql: String,
        /// Lines of the script before it.
        lines_before: u64,
    },
}

/// Collects lines until they are statements.
#[derive(Default)]
pub(super) struct ScriptReader {
    begun: String,
    lines_before: u64,
}

impl ScriptReader {
    /// Returns whether no statement has begun.
    pub fn is_blank(&self) -> bool {
        is_blank_statement(&self.begun)
    }

    /// Forgets the statement that has begun.
    pub fn clear(&mut self) {
        self.begun.clear();
    }

    /// Adds a line, and returns the steps that it completes.
    pub fn push_line(&mut self, line: &str) -> Vec<ScriptStep> {
        if self.is_blank()
            && let Some(command) = parse_command(line)
        {
            self.drop_begun();
            self.lines_before += 1;
            return vec![ScriptStep::Command(command)];
        }
        self.begun.push_str(line);
        self.begun.push('\n');
        let mut steps = Vec::new();
        while let Some((statement, rest)) = line.contains(';').then(|| split_statement(&self.begun)).flatten() {
            let sql = statement.to_owned();
            // The rest stays in its columns.
            let last_line = statement.lines().last().unwrap_or_default();
            let begun = " ".repeat(last_line.chars().count() + 1) + rest;
            let lines_before = self.lines_before;
            self.lines_before += statement.matches('\n').count() as u64;
            self.begun = begun;
            if !is_blank_statement(&sql) {
                steps.push(ScriptStep::Statement { sql, lines_before });
            }
        }
        if self.is_blank() {
            self.drop_begun();
        }
        steps
    }

    /// Returns the last statement, which needs no semicolon.
    pub fn finish(self) -> Option<ScriptStep> {
        (!self.is_blank()).then_some(ScriptStep::Statement { sql: self.begun, lines_before: self.lines_before })
    }

    fn drop_begun(&mut self) {
        self.lines_before += self.begun.matches('\n').count() as u64;
        self.begun.clear();
    }
}

/// Returns the steps of a whole script.
pub(super) fn read_script(text: &str) -> Vec<ScriptStep> {
    let mut reader = ScriptReader::default();
    let mut steps: Vec<_> = text.lines().flat_map(|line| reader.push_line(line)).collect();
    steps.extend(reader.finish());
    steps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_script_is_statements_and_commands() {
        let statement = |sql: &str, lines_before| ScriptStep::Statement { sql: sql.to_owned(), lines_before };
        let steps = read_script("-- first\n\\d runs\nselect ';'; select\n 2;\n;\n\\q\nselect 3");
        let expected = [
            ScriptStep::Command(Ok(PromptCommand::Columns("runs".to_owned()))),
            statement("select ';'", 2),
            statement("            select\n 2", 2),
            ScriptStep::Command(Ok(PromptCommand::Quit)),
            statement("select 3\n", 6),
        ];
        assert_eq!(steps, expected);
        assert_eq!(read_script(" -- nothing\n;"), []);
        assert_eq!(read_script("select '\n\\q'"), [statement("select '\n\\q'\n", 0)]);
    }
}
