//! What people do to a lake: one line of [`OPERATOR_ACTIONS`] each.

use std::io::Write as _;
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, SystemTime};

use echolake_testing::{ChildProcess, run_command};
use rand::Rng as _;

use super::reader::read_measurements;
use super::{OperatorRound, SourceRun, finish, mount_disk, run_to_end};

/// Longest time until a process is killed: a command on such a lake takes a tenth of a second.
const KILL_WITHIN: Duration = Duration::from_millis(300);
/// Two looks of `ingest --watch` at the inbox, and a half.
const WATCH_LOOKS: Duration = Duration::from_millis(5000);
/// The most that a full disk has left beside the run, in bytes: an ingest writes about half of it.
const SPARE_BYTES: u64 = 512 << 10;
const HOUR: Duration = Duration::from_secs(3600);

/// What an action needs of the command or of the machine.
#[derive(Clone, Copy)]
pub(super) enum ActionNeed {
    Nothing,
    Verb(&'static str),
    DeltaLake,
    SmallDisk,
}

/// An action: its name in a failure's sequence, what it needs, and what it does.
pub(super) struct OperatorAction {
    pub name: &'static str,
    pub need: ActionNeed,
    pub run: fn(&mut OperatorRound<'_>) -> Result<(), String>,
}

const fn action(
    name: &'static str,
    need: ActionNeed,
    run: fn(&mut OperatorRound<'_>) -> Result<(), String>,
) -> OperatorAction {
    OperatorAction { name, need, run }
}

pub(super) const OPERATOR_ACTIONS: &[OperatorAction] = &[
    action("copy a run, ingest", ActionNeed::Nothing, copy_run),
    action("copy slowly while `ingest` runs", ActionNeed::Nothing, copy_slowly),
    action("copy slowly under `ingest --watch`", ActionNeed::Nothing, copy_under_watch),
    action("copy a part, ingest, then copy the whole file", ActionNeed::Nothing, copy_part),
    action("copy a run that is there", ActionNeed::Nothing, copy_again),
    action("move something away", ActionNeed::Nothing, move_away),
    action("move back what is away", ActionNeed::Nothing, move_back),
    action("damage a file of a table", ActionNeed::Nothing, damage_table),
    action("delete a table's folder", ActionNeed::Nothing, delete_table),
    action("delete all tables", ActionNeed::Nothing, delete_tables),
    action("replace a run's file", ActionNeed::Nothing, replace_run),
    action("maintain a table by deltalake", ActionNeed::DeltaLake, maintain_table),
    action("fill the disk", ActionNeed::SmallDisk, fill_disk),
    action("unmount the lake", ActionNeed::Nothing, unmount),
    action("set the clock", ActionNeed::Nothing, set_clock),
    action("start two programs", ActionNeed::Nothing, start_two),
    action("kill a program", ActionNeed::Nothing, kill_program),
    action("put a strange entry into the inbox", ActionNeed::Nothing, put_strange_entry),
    action("recover a recording that was cut off", ActionNeed::Nothing, recover),
    action("resume a recording that was cut off", ActionNeed::Nothing, resume),
    action("ingest", ActionNeed::Nothing, ingest),
    action("remove a run", ActionNeed::Verb("remove"), remove),
    action("rebuild a table", ActionNeed::Verb("rebuild"), rebuild),
];

fn copy_run(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(source) = round.next_run() else { return ingest(round) };
    std::fs::copy(&source.file, round.inbox_file(source)).expect("copied");
    ingest(round)
}

fn copy_slowly(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(source) = round.next_run() else { return Ok(()) };
    let bytes = std::fs::read(&source.file).expect("read");
    let (first, rest) = bytes.split_at(round.cut(bytes.len()));
    round.note(format!("  {}: {} of {} bytes", source.run, first.len(), bytes.len()));
    // The copier has its file open, wherever it is moved to.
    let mut file = std::fs::File::create(round.inbox_file(source)).expect("made");
    file.write_all(first).expect("written");
    round.ingest()?;
    round.check_answers()?;
    file.write_all(rest).expect("written");
    drop(file);
    ingest(round)
}

fn copy_under_watch(round: &mut OperatorRound<'_>) -> Result<(), String> {
    // It takes ten times as long as other actions.
    if round.random.random_bool(0.7) {
        return copy_slowly(round);
    }
    let Some(source) = round.next_run() else { return Ok(()) };
    let bytes = std::fs::read(&source.file).expect("read");
    let (first, rest) = bytes.split_at(round.cut(bytes.len()));
    round.note(format!("  {}: {} of {} bytes", source.run, first.len(), bytes.len()));
    let mut watch = ChildProcess::start(&mut round.command(&["ingest", "--watch"])).expect("it starts");
    let mut file = std::fs::File::create(round.inbox_file(source)).expect("made");
    file.write_all(first).expect("written");
    watch.ends_within(WATCH_LOOKS);
    file.write_all(rest).expect("written");
    drop(file);
    if !watch.ends_within(WATCH_LOOKS) {
        watch.signal("INT");
    }
    let end = finish(&mut watch, "ingest --watch")?;
    round.note(format!("  ingest --watch: {:?} {}", end.code, end.stderr.trim().replace('\n', " | ")));
    round.acknowledge(&end)
}

fn copy_part(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(source) = round.next_run() else { return Ok(()) };
    let bytes = std::fs::read(&source.file).expect("read");
    let cut = round.cut(bytes.len());
    let is_partial = round.random.random_bool(0.3);
    round.note(format!("  {}: {cut} of {} bytes, .partial: {is_partial}", source.run, bytes.len()));
    let whole = round.inbox_file(source);
    let part = if is_partial { whole.with_extension("mcap.partial") } else { whole.clone() };
    std::fs::write(&part, &bytes[..cut]).expect("written");
    round.ingest()?;
    round.check_answers()?;
    // A copier that ends renames its file.
    let _ = std::fs::remove_file(part);
    std::fs::write(whole, bytes).expect("written");
    ingest(round)
}

fn copy_again(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let source = round.any_run();
    std::fs::copy(&source.file, round.inbox_file(source)).expect("copied");
    ingest(round)
}

fn move_away(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let (place, what) = match round.random.random_range(0..6) {
        0 => (round.any_table_file(), Witness::Tables),
        1 => (round.any_table(), Witness::Tables),
        2 => (Some(round.path("tables")), Witness::Tables),
        3 => (Some(round.path("runs")), Witness::Files),
        4 => (round.any_run_file(), Witness::Files),
        _ => (any_entry(round, "inbox"), Witness::Neither),
    };
    let Some(place) = place.filter(|place| place.exists()) else { return Ok(()) };
    if !round.destroys(what) {
        return Ok(());
    }
    round.note(format!("  {}", place.display()));
    let at = round.folder.join("away").join(round.away.len().to_string());
    std::fs::rename(&place, &at).expect("moved");
    if matches!(what, Witness::Files) {
        round.lost_files.extend(
            round.campaign.runs.iter().filter(|s| round.acknowledged.contains_key(&s.run)).map(|s| s.run.clone()),
        );
    }
    round.away.push((place, at));
    maybe_ingest(round)
}

fn move_back(round: &mut OperatorRound<'_>) -> Result<(), String> {
    round.put_back();
    maybe_ingest(round)
}

fn damage_table(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(file) = round.any_table_file() else { return Ok(()) };
    if !round.destroys(Witness::Tables) {
        return Ok(());
    }
    let bytes = std::fs::read(&file).expect("read");
    // A log that lost its newest commits is a whole log of an earlier version. Rows of other tables say what is
    // missing; of `runs` only `doctor` does, by the run's file.
    let log = round.path("tables/runs/_delta_log");
    let is_pointer = entries(&log).iter().rfind(|path| path.extension().is_some_and(|e| e == "json")) == Some(&file);
    let how = match round.random.random_range(u32::from(is_pointer)..4) {
        0 => std::fs::remove_file(&file).map(|()| "deleted".to_owned()),
        1 => std::fs::write(&file, []).map(|()| "emptied".to_owned()),
        2 => {
            let lines: Vec<_> = bytes.iter().enumerate().filter(|(_, b)| **b == b'\n').map(|(at, _)| at + 1).collect();
            let end = if lines.is_empty() { 0 } else { lines[round.random.random_range(0..lines.len())] };
            std::fs::write(&file, &bytes[..end]).map(|()| format!("cut at a line's end, {end}"))
        }
        _ => {
            let end = round.random.random_range(0..bytes.len().max(1));
            std::fs::write(&file, &bytes[..end]).map(|()| format!("cut at {end} of {}", bytes.len()))
        }
    };
    round.note(format!("  {} {}", file.display(), how.expect("written")));
    maybe_ingest(round)
}

fn delete_table(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(table) = round.any_table() else { return Ok(()) };
    if !round.destroys(Witness::Tables) {
        return Ok(());
    }
    round.note(format!("  {}", table.display()));
    std::fs::remove_dir_all(table).expect("removed");
    maybe_ingest(round)
}

fn delete_tables(round: &mut OperatorRound<'_>) -> Result<(), String> {
    if !round.destroys(Witness::Tables) {
        return Ok(());
    }
    let _ = std::fs::remove_dir_all(round.path("tables"));
    maybe_ingest(round)
}

fn replace_run(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(place) = round.any_run_file() else { return Ok(()) };
    let stem = place.file_stem().expect("a name").to_string_lossy().into_owned();
    if !round.campaign.runs.iter().any(|source| source.run == stem) || !round.destroys(Witness::Files) {
        return Ok(());
    }
    let mut bytes = std::fs::read(&round.any_run().file).expect("read");
    if round.random.random_bool(0.5) {
        let whole = std::fs::read(&place).expect("read");
        bytes = whole[..round.cut(whole.len())].to_vec();
    }
    round.note(format!("  {}: {} bytes", place.display(), bytes.len()));
    round.lost_files.insert(stem);
    std::fs::write(place, bytes).expect("written");
    maybe_ingest(round)
}

fn maintain_table(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(table) = round.any_table() else { return Ok(()) };
    let how = ["optimize.compact()", "vacuum(0, dry_run=False, enforce_retention_duration=False)", "delete()"];
    let how = how[round.random.random_range(0..how.len())];
    if !round.destroys(Witness::Tables) {
        return Ok(());
    }
    let script = format!("import deltalake, sys; deltalake.DeltaTable(sys.argv[1]).{how}");
    let python = round.campaign.python.as_ref().expect("it is needed");
    // It refuses tables that were damaged before.
    let done = run_command(Command::new(python).args(["-c", &script]).arg(&table)).expect("Python starts");
    round.note(format!("  {how} of {}: {:?}", table.display(), done.status.code()));
    maybe_ingest(round)
}

fn fill_disk(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(source) = round.next_run() else { return Ok(()) };
    let disk = round.folder.join("full");
    let lake = round.path("");
    // Whole pages of each file, and the run that is copied to it.
    let used: u64 = sizes(&lake).iter().map(|size| size.next_multiple_of(4096) + 4096).sum();
    let file = std::fs::metadata(&source.file).expect("there").len();
    let spare = round.random.random_range(0..SPARE_BYTES);
    assert!(mount_disk(&disk, &(used + file + spare).to_string()), "it was mounted before");
    copy_entries(&lake, &disk.join("lake"));
    std::fs::copy(&source.file, disk.join("lake/inbox").join(source.file_name())).expect("copied");
    round.note(format!("  {}: {spare} bytes are left", source.run));
    round.lake = "full/lake";
    let checked = round.ingest().and_then(|_| round.check_answers());
    round.lake = "lake";
    checked?;
    std::fs::remove_dir_all(&lake).expect("removed");
    copy_entries(&disk.join("lake"), &lake);
    assert!(super::succeeds(Command::new("umount").arg(&disk)), "unmounted");
    Ok(())
}

fn unmount(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let (lake, away) = (round.path(""), round.folder.join("unmounted"));
    let mut query = ChildProcess::start(&mut round.command(&["sql", "--format", "csv", super::MEASUREMENTS_QUERY]))
        .expect("it starts");
    let moment = KILL_WITHIN.mul_f64(round.random.random());
    query.ends_within(moment);
    std::fs::rename(&lake, &away).expect("moved");
    let has_folder = round.random.random_bool(0.5);
    if has_folder {
        // A mount point stays.
        std::fs::create_dir(&lake).expect("made");
    }
    let end = finish(&mut query, "sql while the lake is unmounted");
    let checked = round.check_answers();
    if has_folder {
        std::fs::remove_dir_all(&lake).expect("removed");
    }
    std::fs::rename(&away, &lake).expect("moved");
    let end = end?;
    if end.code == Some(0) {
        round.judge("measurements", false, &end.stdout).map_err(|e| format!("`sql` while it was unmounted: {e}"))?;
    }
    checked
}

fn set_clock(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let next = round.next_run();
    if let Some(source) = next {
        std::fs::copy(&source.file, round.inbox_file(source)).expect("copied");
    }
    let hours = round.random.random_range(1..1000);
    if round.random.random_bool(0.5) && round.campaign.has_faketime {
        let sign = if round.random.random_bool(0.5) { '-' } else { '+' };
        let mut command = Command::new("faketime");
        command.args(["-f", &format!("{sign}{hours}h")]).arg(&round.campaign.binary).args(["--lake", round.lake]);
        let verb = ["ingest", "vacuum", "optimize"][round.random.random_range(0..3)];
        let end = run_to_end(command.arg(verb).current_dir(&round.folder))?;
        round.note(format!("  {sign}{hours} h: {verb} {:?} {}", end.code, end.stderr.trim().replace('\n', " | ")));
        round.acknowledge(&end)
    } else {
        let then = SystemTime::now() - HOUR * hours;
        let then = if round.random.random_bool(0.5) { then } else { SystemTime::now() + HOUR * hours };
        for file in files(&round.path("")) {
            if round.random.random_bool(0.5) {
                let opened = std::fs::File::options().write(true).open(file).expect("opened");
                opened.set_modified(then).expect("a time");
            }
        }
        round.note(format!("  times of files: {hours} h"));
        ingest(round)
    }
}

fn start_two(round: &mut OperatorRound<'_>) -> Result<(), String> {
    if let Some(source) = round.next_run() {
        std::fs::copy(&source.file, round.inbox_file(source)).expect("copied");
    }
    let query = ["sql", "--format", "csv", super::MEASUREMENTS_QUERY];
    let others: [&[&str]; 4] = [&["ingest"], &["optimize"], &["vacuum"], &query];
    let other = others[round.random.random_range(0..others.len())];
    let before = round.acknowledged.clone();
    let mut children =
        [&["ingest"][..], other].map(|args| ChildProcess::start(&mut round.command(args)).expect("it starts"));
    let ends = children.each_mut().map(|child| finish(child, "one of two programs"));
    for (end, name) in ends.into_iter().zip(["ingest", other[0]]) {
        let end = end?;
        round.note(format!("  {name}: {:?} {}", end.code, end.stderr.trim().replace('\n', " | ")));
        if name == "sql" && end.code == Some(0) {
            // What the ingest beside it acknowledged may be later than this answer.
            let now = std::mem::replace(&mut round.acknowledged, before.clone());
            round.judge("measurements", false, &end.stdout).map_err(|e| format!("`sql` beside `ingest`: {e}"))?;
            round.acknowledged = now;
        }
        round.acknowledge(&end)?;
    }
    Ok(())
}

fn kill_program(round: &mut OperatorRound<'_>) -> Result<(), String> {
    if let Some(source) = round.next_run() {
        std::fs::copy(&source.file, round.inbox_file(source)).expect("copied");
    }
    let verbs: Vec<_> = ["ingest", "optimize", "vacuum", "rebuild"]
        .into_iter()
        .filter(|verb| round.campaign.verbs.contains(*verb))
        .collect();
    let verb = verbs[round.random.random_range(0..verbs.len())];
    let moment = KILL_WITHIN.mul_f64(round.random.random());
    let mut child = ChildProcess::start(&mut round.command(&[verb])).expect("it starts");
    let has_ended = child.ends_within(moment);
    child.kill();
    if verb == "rebuild" {
        round.lost_tables = true;
    }
    round.note(format!("  {verb} after {moment:?}, ended before: {has_ended}"));
    Ok(())
}

fn put_strange_entry(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let inbox = round.path("inbox");
    let kind = round.random.random_range(0..8);
    let place = match kind {
        0 => inbox.join("pipe.mcap"),
        1 => inbox.join("pipe.mcap.partial"),
        2 => inbox.join(std::ffi::OsStr::from_bytes(b"caf\xe9.mcap")),
        3 => inbox.join("tab\tand\nline.mcap"),
        4 => inbox.join(format!("{}.mcap", "n".repeat(250))),
        5 => inbox.join("up"),
        6 => inbox.join("link.mcap"),
        _ => inbox.join("folder.mcap"),
    };
    if place.symlink_metadata().is_ok() {
        return ingest(round);
    }
    round.note(format!("  {place:?}"));
    match kind {
        0 | 1 => assert!(super::succeeds(Command::new("mkfifo").arg(&place)), "a FIFO"),
        5 => std::os::unix::fs::symlink("..", &place).expect("a link"),
        6 => std::os::unix::fs::symlink(round.folder.join("rig.toml"), &place).expect("a link"),
        7 => std::fs::create_dir(&place).expect("made"),
        _ => std::fs::write(&place, "no run").expect("written"),
    }
    round.strange.push(place);
    copy_run(round)
}

fn recover(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let source = round.next_run().unwrap_or(&round.campaign.runs[0]);
    let partial = round.folder.join(format!("{}.partial", source.file_name()));
    let out = round.folder.join(source.file_name());
    let _ = std::fs::remove_file(&out);
    let bytes = std::fs::read(&source.file).expect("read");
    let cut = round.cut(bytes.len());
    std::fs::write(&partial, &bytes[..cut]).expect("written");
    round.note(format!("  {}: {cut} of {} bytes", source.run, bytes.len()));
    let there = read_measurements(&partial);
    let [from, to] = [&partial, &out].map(|path| path.to_str().expect("a path").to_owned());
    let end = round.echolake(&["recover", &from, "-o", &to])?;
    if !matches!(end.code, Some(0 | 3)) {
        return match there.len() {
            0 => Ok(()),
            count => Err(format!("recover gives up {count} measurements that are whole: {}", end.stderr)),
        };
    }
    let kept = read_measurements(&out);
    if let Some(lost) = there.iter().find(|row| !kept.contains(row)) {
        return Err(format!("recover lost a measurement that is whole: {lost}"));
    }
    // Without the verb, a part that was ingested cannot make way for the whole file.
    if round.campaign.verbs.contains("remove") && !round.acknowledged.contains_key(&source.run) {
        std::fs::copy(&out, round.inbox_file(source)).expect("copied");
        // What it says of a part is not an acknowledgement of the whole.
        round.echolake(&["ingest"])?;
    }
    Ok(())
}

fn resume(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let source = &round.campaign.resumed;
    if round.acknowledged.contains_key(&source.run) {
        return Ok(());
    }
    let whole = round.inbox_file(source);
    let partial = whole.with_extension("mcap.partial");
    let bytes = std::fs::read(&source.file).expect("read");
    let cut = round.cut(bytes.len());
    std::fs::write(&partial, &bytes[..cut]).expect("written");
    round.note(format!("  {}: {cut} of {} bytes", source.run, bytes.len()));
    let there = read_measurements(&partial);
    let end = round.echolake(&["acquire", "--resume", partial.to_str().expect("a path")])?;
    if end.code != Some(0) {
        let _ = std::fs::remove_file(&partial);
        return match there.len() {
            0 => Ok(()),
            count => Err(format!("resume gives up {count} measurements that are whole: {}", end.stderr)),
        };
    }
    let resumed = read_measurements(&whole);
    if let Some(lost) = there.iter().find(|row| !resumed.contains(row)) {
        return Err(format!("resume lost a measurement that is whole: {lost}"));
    }
    if resumed.len() != source.measurements.len() {
        return Err(format!("resume ended with 0 and {} measurements", resumed.len()));
    }
    let end = round.ingest()?;
    if end.code == Some(0) && end.stderr.contains(&format!("{}: {} measurements", source.run, resumed.len())) {
        round.acknowledged.insert(source.run.clone(), resumed);
    } else {
        // Its file is whole: it becomes rows when what keeps the ingest from them is repaired, but nobody was told.
        let _ = std::fs::remove_file(whole);
    }
    Ok(())
}

fn ingest(round: &mut OperatorRound<'_>) -> Result<(), String> {
    round.ingest().map(drop)
}

fn remove(round: &mut OperatorRound<'_>) -> Result<(), String> {
    // All others rest on references.
    let source = &round.campaign.runs[round.random.random_range(super::FIRST_RUNS..round.campaign.runs.len())];
    let dry = round.echolake(&["remove", &source.run, "--dry-run"])?;
    round.check_answers()?;
    let end = round.echolake(&["remove", &source.run])?;
    if end.code == Some(0) {
        if dry.code != Some(0) {
            return Err(format!("remove --dry-run ended with {:?}, remove with 0: {}", dry.code, dry.stderr));
        }
        round.acknowledged.remove(&source.run);
        round.lost_files.remove(&source.run);
        let rows = round.command(&["sql", "--format", "csv", super::MEASUREMENTS_QUERY]).output().expect("it starts");
        if rows.status.success() && String::from_utf8_lossy(&rows.stdout).contains(&source.run) {
            return Err(format!("remove ended with 0, and rows of {} are there", source.run));
        }
    } else {
        // It may have begun.
        round.acknowledged.remove(&source.run);
    }
    Ok(())
}

fn rebuild(round: &mut OperatorRound<'_>) -> Result<(), String> {
    let Some(table) = round.any_table() else { return Ok(()) };
    let name = table.file_name().expect("a name").to_string_lossy().into_owned();
    let end = match round.random.random_bool(0.5) {
        true => round.echolake(&["rebuild", &name])?,
        false => round.echolake(&["rebuild"])?,
    };
    if end.code != Some(0) {
        round.lost_tables = true;
    }
    Ok(())
}

fn maybe_ingest(round: &mut OperatorRound<'_>) -> Result<(), String> {
    round.check_answers()?;
    match round.random.random_bool(0.5) {
        true => ingest(round),
        false => Ok(()),
    }
}

/// What bears witness to a run: its rows or its file.
#[derive(Clone, Copy)]
enum Witness {
    Tables,
    Files,
    Neither,
}

impl<'a> OperatorRound<'a> {
    /// Returns whether this witness may be destroyed. A run whose rows and file are both gone is named by nothing that
    /// a command could read: such rounds would blame the program for it.
    fn destroys(&mut self, witness: Witness) -> bool {
        match witness {
            Witness::Tables if self.lost_files.is_empty() => self.lost_tables = true,
            Witness::Files if !self.lost_tables => {}
            Witness::Neither => {}
            _ => return false,
        }
        true
    }

    /// A run that is not acknowledged yet.
    fn next_run(&mut self) -> Option<&'a SourceRun> {
        let campaign = self.campaign;
        let left: Vec<_> = campaign.runs.iter().filter(|source| !self.acknowledged.contains_key(&source.run)).collect();
        (!left.is_empty()).then(|| left[self.random.random_range(0..left.len())])
    }

    fn any_run(&mut self) -> &'a SourceRun {
        let campaign = self.campaign;
        &campaign.runs[self.random.random_range(0..campaign.runs.len())]
    }

    fn inbox_file(&self, source: &SourceRun) -> PathBuf {
        let inbox = self.path("inbox");
        std::fs::create_dir_all(&inbox).expect("made");
        inbox.join(source.file_name())
    }

    /// Where a file of so many bytes is cut: anywhere, or, in half of the cases, among its measurements.
    fn cut(&mut self, length: usize) -> usize {
        let least = if self.random.random_bool(0.5) { 0.93 } else { 0.0 };
        (length as f64 * self.random.random_range(least..1.0)) as usize
    }

    fn any_table(&mut self) -> Option<PathBuf> {
        let mut tables = entries(&self.path("tables"));
        tables.retain(|path| path.join("_delta_log").is_dir());
        self.any(tables)
    }

    fn any_table_file(&mut self) -> Option<PathBuf> {
        let table = self.any_table()?;
        let files = files(&table);
        self.any(files)
    }

    fn any_run_file(&mut self) -> Option<PathBuf> {
        let files = files(&self.path("runs"));
        self.any(files)
    }

    fn any(&mut self, mut paths: Vec<PathBuf>) -> Option<PathBuf> {
        (!paths.is_empty()).then(|| paths.swap_remove(self.random.random_range(0..paths.len())))
    }
}

fn any_entry(round: &mut OperatorRound<'_>, folder: &str) -> Option<PathBuf> {
    let entries = entries(&round.path(folder));
    round.any(entries)
}

// Copies a folder with its pipes and links as they are.
fn copy_entries(from: &Path, to: &Path) {
    assert!(super::succeeds(Command::new("cp").arg("-a").args([from, to])), "copied");
}

// In an order that a seed repeats.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect();
    paths.sort();
    paths
}

// Regular files below a folder; links are not followed.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for path in entries(folder) {
        let Ok(kind) = path.symlink_metadata().map(|meta| meta.file_type()) else { continue };
        if kind.is_dir() {
            found.extend(files(&path));
        } else if kind.is_file() {
            found.push(path);
        }
    }
    found
}

fn sizes(folder: &Path) -> Vec<u64> {
    files(folder).iter().filter_map(|file| file.metadata().ok()).map(|meta| meta.len()).collect()
}
