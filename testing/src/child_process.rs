//! Programs that tests start. No test waits for one without a limit: when it is reached, the test fails with what the
//! program said so far, and the program is killed.

use std::io::{self, ErrorKind, Read};
use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// For commands on small lakes. They take a second; a busy machine may need a hundred times that.
pub const COMMAND_LIMIT: Duration = Duration::from_secs(300);
/// For programs that install packages, drive a browser, or measure the paper's whole rig.
pub const LONG_LIMIT: Duration = Duration::from_secs(1800);
/// Time limit for a killed process to be gone. One that waits for a broken disk may never be.
const KILL_LIMIT: Duration = Duration::from_secs(10);
/// Between two looks at a process that has no pipe to hear its end from.
const POLL_EVERY: Duration = Duration::from_millis(2);
/// Bytes of each pipe that a failure repeats.
const REPEATED_BYTES: usize = 8 << 10;

/// A started program. Dropped, it is killed.
pub struct ChildProcess {
    child: Child,
    name: String,
    limit: Duration,
    has_group: bool,
    /// True if its exit status was read: from then on its id may be another process's.
    is_reaped: bool,
    transcript: Arc<OutputTranscript>,
}

/// The output of a program so far, and a condition that is notified when there is more.
#[derive(Default)]
struct OutputTranscript {
    pipes: Mutex<[PipeText; 2]>,
    news: Condvar,
}

#[derive(Default)]
struct PipeText {
    bytes: Vec<u8>,
    is_open: bool,
}

const STDOUT: usize = 0;
const STDERR: usize = 1;

/// Runs a program to its end within [`COMMAND_LIMIT`].
///
/// # Errors
/// The program cannot be started.
pub fn run_command(command: &mut Command) -> io::Result<Output> {
    Ok(ChildProcess::start(command)?.wait())
}

/// Runs a program that may start others to its end within [`LONG_LIMIT`].
///
/// # Errors
/// The program cannot be started.
pub fn run_long_command(command: &mut Command) -> io::Result<Output> {
    Ok(ChildProcess::start_group(command)?.wait())
}

impl ChildProcess {
    /// Starts a program that starts no others. Each wait for it has [`COMMAND_LIMIT`].
    ///
    /// # Errors
    /// The program cannot be started.
    pub fn start(command: &mut Command) -> io::Result<Self> {
        Self::spawn(command, COMMAND_LIMIT, false)
    }

    /// Starts a program in a process group of its own, with which it is killed. Each wait for it has [`LONG_LIMIT`].
    ///
    /// # Errors
    /// The program cannot be started.
    pub fn start_group(command: &mut Command) -> io::Result<Self> {
        Self::spawn(command.process_group(0), LONG_LIMIT, true)
    }

    fn spawn(command: &mut Command, limit: Duration, has_group: bool) -> io::Result<Self> {
        let name = format!("{command:?}");
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
        let transcript = Arc::new(OutputTranscript::default());
        transcript.lock().iter_mut().for_each(|pipe| pipe.is_open = true);
        // These threads are never joined: a process that this one knows nothing of may hold a pipe open for ever.
        spawn_reader(child.stdout.take().expect("stdout is piped"), STDOUT, &transcript);
        spawn_reader(child.stderr.take().expect("stderr is piped"), STDERR, &transcript);
        Ok(Self { child, name, limit, has_group, is_reaped: false, transcript })
    }

    /// Returns its process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns whether it has not ended yet.
    pub fn is_running(&mut self) -> bool {
        self.exit_status().is_none()
    }

    /// Returns what it wrote to stderr so far.
    pub fn stderr(&self) -> String {
        lossy_text(&self.transcript.lock()[STDERR].bytes)
    }

    /// Waits for a line on stderr with this text in it, and returns the line.
    ///
    /// # Panics
    /// The limit is reached, or the program ends without it.
    pub fn wait_for_line(&mut self, part: &str) -> String {
        let end = Instant::now() + self.limit;
        self.wait_for(end, &format!("line with `{part}`"), |pipes| {
            let whole = lossy_text(&pipes[STDERR].bytes);
            let mut lines = whole.split_inclusive('\n').filter(|line| line.ends_with('\n'));
            let found = lines.find(|line| line.contains(part)).map(|line| line.trim_end().to_owned());
            // What does not come before its end never comes.
            if found.is_none() && !pipes[STDERR].is_open { Some(None) } else { found.map(Some) }
        })
        .unwrap_or_else(|| panic!("{} ended without a line with `{part}`:\n{}", self.name, self.repeated()))
    }

    /// Waits for its end and that of all that it writes.
    ///
    /// # Panics
    /// The limit is reached.
    pub fn wait(&mut self) -> Output {
        let end = Instant::now() + self.limit;
        self.wait_for(end, "end", |pipes| pipes.iter().all(|pipe| !pipe.is_open).then_some(()));
        let status = loop {
            match self.exit_status() {
                Some(status) => break status,
                None if Instant::now() >= end => self.give_up("exit"),
                None => std::thread::sleep(POLL_EVERY),
            }
        };
        let mut pipes = self.transcript.lock();
        let [stdout, stderr] = std::mem::take(&mut *pipes).map(|pipe| pipe.bytes);
        Output { status, stdout, stderr }
    }

    /// Waits for its end, but not longer than `time`; returns whether it ended.
    pub fn ends_within(&mut self, time: Duration) -> bool {
        let end = Instant::now() + time;
        loop {
            if !self.is_running() {
                return true;
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            std::thread::sleep(left.min(POLL_EVERY));
        }
    }

    /// Sends it a signal, as `INT`.
    pub fn signal(&self, name: &str) {
        let sent = run_command(Command::new("kill").args([format!("-{name}"), self.id().to_string()]));
        let sent = sent.expect("kill starts");
        assert!(sent.status.success(), "{}: {}", self.name, lossy_text(&sent.stderr));
    }

    /// Kills it by SIGKILL, after which nothing of it runs.
    ///
    /// # Panics
    /// It is not gone after a while.
    pub fn kill(&mut self) {
        self.send_kill();
        assert!(self.ends_within(KILL_LIMIT), "{} cannot be killed", self.name);
    }

    fn send_kill(&mut self) {
        if self.has_group && !self.is_reaped {
            let group = format!("-{}", self.id());
            let kill = Self::start(Command::new("kill").args(["-KILL", "--", &group]));
            let _ = kill.map(|mut kill| kill.ends_within(KILL_LIMIT));
        }
        // It may have ended already.
        let _ = self.child.kill();
    }

    fn exit_status(&mut self) -> Option<ExitStatus> {
        let status = self.child.try_wait().expect("its state");
        self.is_reaped |= status.is_some();
        status
    }

    fn wait_for<T>(&self, end: Instant, what: &str, find: impl Fn(&[PipeText; 2]) -> Option<T>) -> T {
        let mut pipes = self.transcript.lock();
        loop {
            if let Some(found) = find(&pipes) {
                return found;
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                drop(pipes);
                self.give_up(what);
            }
            pipes = self.transcript.news.wait_timeout(pipes, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn give_up(&self, what: &str) -> ! {
        panic!("{}: no {what} within {:?}; it said so far:\n{}", self.name, self.limit, self.repeated())
    }

    fn repeated(&self) -> String {
        let pipes = self.transcript.lock();
        let end = |bytes: &[u8]| lossy_text(&bytes[bytes.len().saturating_sub(REPEATED_BYTES)..]);
        format!("stderr: {}\nstdout: {}", end(&pipes[STDERR].bytes), end(&pipes[STDOUT].bytes))
    }
}

impl Drop for ChildProcess {
    fn drop(&mut self) {
        self.send_kill();
        // A panic here would hide the one that unwinds.
        self.ends_within(KILL_LIMIT);
    }
}

impl OutputTranscript {
    fn lock(&self) -> MutexGuard<'_, [PipeText; 2]> {
        self.pipes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn spawn_reader(mut pipe: impl Read + Send + 'static, number: usize, transcript: &Arc<OutputTranscript>) {
    let transcript = transcript.clone();
    std::thread::spawn(move || {
        let mut block = [0; 8 << 10];
        loop {
            match pipe.read(&mut block) {
                Ok(0) => break,
                Ok(count) => transcript.lock()[number].bytes.extend_from_slice(&block[..count]),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => break,
            }
            transcript.news.notify_all();
        }
        transcript.lock()[number].is_open = false;
        transcript.news.notify_all();
    });
}

fn lossy_text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};
    use std::path::Path;

    use super::*;

    /// A shell with this script, which has said that it is ready.
    fn shell(script: &str) -> ChildProcess {
        let mut shell = ChildProcess::start_group(Command::new("sh").args(["-c", script])).expect("a shell");
        shell.wait_for_line("ready");
        shell
    }

    fn failure<T>(wait: impl FnOnce() -> T) -> String {
        let Err(panic) = catch_unwind(AssertUnwindSafe(wait)) else { panic!("it did not fail") };
        *panic.downcast::<String>().expect("a text")
    }

    #[test]
    fn waiting_too_long_fails_with_what_was_said() {
        let mut shell = shell("echo ready >&2; exec sleep 600");
        shell.limit = Duration::from_millis(50);
        let said = failure(|| shell.wait());
        assert!(said.contains("no end within 50ms") && said.contains("ready"), "{said}");
        let said = failure(|| shell.wait_for_line("done"));
        assert!(said.contains("no line with `done`") && said.contains("ready"), "{said}");
    }

    #[test]
    fn an_early_end_is_not_waited_for() {
        let said = failure(|| shell("echo ready >&2").wait_for_line("done"));
        assert!(said.contains("ended without a line with `done`") && said.contains("ready"), "{said}");
    }

    // The second shell holds the pipe that the first one was given.
    #[test]
    fn a_grandchild_is_killed_with_its_group() {
        let shell = shell("sh -c 'echo $$ >&2; echo ready >&2; sleep 600; true' & wait");
        let grandchild = shell.stderr().lines().next().expect("an id").to_owned();
        drop(shell);
        let end = Instant::now() + COMMAND_LIMIT;
        while Path::new("/proc").join(&grandchild).join("cwd").exists() {
            assert!(Instant::now() < end, "process {grandchild} is still there");
            std::thread::sleep(POLL_EVERY);
        }
    }

    #[test]
    fn output_and_exit_code_are_those_of_the_program() {
        let output = run_command(Command::new("sh").args(["-c", "echo out; echo err >&2; exit 3"])).expect("a shell");
        let said = [&output.stdout, &output.stderr].map(|bytes| lossy_text(bytes));
        assert_eq!((output.status.code(), said), (Some(3), ["out\n".to_owned(), "err\n".to_owned()]));
    }
}
