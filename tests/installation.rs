//! The command as packages use it: its report about itself, man pages and completions.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use echolake_testing::run_command;
use serde::Deserialize;

use super::{ECHOLAKE, TestFolder, stderr};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SelfReport {
    version: String,
    commit: Option<String>,
    program: String,
    facts: Vec<ReportedFact>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct ReportedFact {
    name: String,
    state: String,
    found: String,
    hint: Option<String>,
}

impl SelfReport {
    fn of(command: &mut Command) -> Self {
        let output = run_command(command).expect("the command starts");
        serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", stderr(&output)))
    }

    fn fact(&self, name: &str) -> &ReportedFact {
        self.facts.iter().find(|fact| fact.name == name).unwrap_or_else(|| panic!("no {name} in {self:?}"))
    }
}

#[test]
fn doctor_reports_the_installation_and_leaves_nothing_behind() {
    let place = TestFolder::new();
    let before = fs::read_dir(place.path("")).expect("a folder").count();
    let report = SelfReport::of(&mut place.command(&["doctor", "--self", "--json"]));
    assert_eq!(report.version, env!("CARGO_PKG_VERSION"));
    assert!(report.program.ends_with("echolake"), "{}", report.program);
    assert!(report.commit.is_none_or(|commit| !commit.is_empty()));
    for fact in &report.facts {
        assert!(["ok", "note"].contains(&fact.state.as_str()), "{fact:?}");
        assert!(!fact.found.is_empty(), "{fact:?}");
        assert_eq!(fact.hint.is_some(), fact.state == "note", "{fact:?}");
    }
    let names: Vec<_> = report.facts.iter().map(|fact| fact.name.as_str()).collect();
    let expected = [
        "pages",
        "audio",
        "formats",
        "system",
        "processor",
        "memory",
        "lake",
        "lake's disk",
        "lake's files",
        "temporary files",
        "port 8080",
        "port 8081",
        "port 5433",
    ];
    assert_eq!(names, expected);
    let pages = &report.facts[0];
    let is_remedy_named = pages.hint.as_ref().is_some_and(|hint| hint.contains("pip install echolake"));
    assert!(pages.state == "ok" || is_remedy_named, "{pages:?}");
    assert_eq!(fs::read_dir(place.path("")).expect("a folder").count(), before);
    let text = place.ok(&["doctor", "--self"]);
    assert!(expected.iter().all(|name| text.contains(name)), "{text}");
}

#[test]
fn facts_are_those_of_the_place() {
    let place = TestFolder::new();
    let own = ["doctor", "--self", "--json"];
    // The port is taken, by this test or by another program.
    let _taken = TcpListener::bind("127.0.0.1:5433");
    let report = SelfReport::of(&mut place.command(&own));
    let port = report.fact("port 5433");
    assert_eq!(port.state, "note", "{port:?}");
    let formats = &report.fact("formats").found;
    for name in ["mcap", "parquet", "arrow", "datafusion"] {
        let version = formats.split(", ").find_map(|part| part.strip_prefix(&format!("{name} ")));
        assert!(version.is_some_and(|version| version.contains('.')), "{name} in {formats}");
    }
    // There is no lake yet, so that its disk is that of the folder above.
    let disk = &report.fact("lake's disk").found;
    let folder = place.path("").canonicalize().expect("a folder").display().to_string();
    assert!(disk.ends_with(folder.trim_end_matches('/')), "{disk}, not {folder}");
    let no_folder = SelfReport::of(Command::new(ECHOLAKE).args(["--lake", "memory://"]).args(own));
    assert!(no_folder.facts.iter().all(|fact| fact.name != "lake's disk"), "{no_folder:?}");
    let no_files = SelfReport::of(place.command(&own).env("TMPDIR", "/dev/null"));
    let files = no_files.fact("temporary files");
    assert!(files.state == "failed" && files.found.starts_with("cannot make a folder in /dev/null"), "{files:?}");
}

#[test]
fn a_lake_that_cannot_be_is_a_failure() {
    let place = TestFolder::new();
    fs::write(place.path("lake"), "no folder").expect("written");
    let output = place.run(&["doctor", "--self"]);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.contains("this installation cannot do its job here: lake"), "{said}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("it is a file"));
}

#[test]
fn packages_get_man_pages_and_completions() {
    let place = TestFolder::new();
    place.ok(&["man", "man"]);
    for (page, expected) in
        [("echolake.1", "doctor"), ("echolake-serve.1", "flight"), ("echolake-import-wav.1", "manifest")]
    {
        let text = fs::read_to_string(place.path("man").join(page)).expect(page);
        assert!(text.contains(expected), "{page}");
    }
    for shell in ["bash", "zsh", "fish"] {
        assert!(place.ok(&["completions", shell]).contains("echolake"), "{shell}");
    }
}

/// Units of the Debian package that an administrator enables.
const UNITS: [&str; 4] =
    ["echolake.service", "echolake-ingest.service", "echolake-doctor.timer", "echolake-backup.timer"];

fn packaging() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("packaging")
}

#[test]
fn units_of_the_package_call_commands_that_exist() {
    let debian = packaging().join("debian");
    let scripts = ["postinst", "postrm", "prerm"].map(|name| fs::read_to_string(debian.join(name)).expect("a script"));
    for unit in UNITS {
        assert!(debian.join(unit).exists(), "{unit}");
        assert!(scripts.iter().all(|script| script.contains(unit)), "{unit} is in all scripts of the package");
        if let Some(timed) = unit.strip_suffix(".timer") {
            assert!(debian.join(format!("{timed}.service")).exists(), "{unit} starts a service of its name");
        }
    }
    let mut commands = Vec::new();
    for entry in fs::read_dir(&debian).expect("a folder") {
        let path = entry.expect("an entry").path();
        let text = fs::read_to_string(&path).expect("text");
        if path.extension().is_some_and(|ending| ending == "service") {
            commands.extend(text.lines().filter_map(|line| line.strip_prefix("ExecStart=")).map(str::to_owned));
            assert!(text.contains("User=echolake\n") && text.contains("NoNewPrivileges=yes\n"), "{}", path.display());
        }
    }
    commands.sort();
    assert_eq!(
        commands,
        [
            "/usr/bin/echolake doctor",
            "/usr/bin/echolake ingest --watch",
            "/usr/bin/echolake serve $ECHOLAKE_SERVE_OPTIONS",
            "/usr/lib/echolake/backup"
        ]
    );
    for command in commands.iter().filter_map(|command| command.strip_prefix("/usr/bin/echolake ")) {
        let mut words: Vec<_> = command.split(' ').filter(|word| !word.starts_with('$')).collect();
        words.push("--help");
        assert!(run_command(Command::new(ECHOLAKE).args(&words)).expect("it starts").status.success(), "{command}");
    }
}

#[test]
fn the_debian_package_has_units_alerts_and_the_backup() {
    let place = TestFolder::new();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (source, documents) = (place.path("source"), place.path("documents"));
    for folder in ["source/docs/grafana", "source/python", "documents/man", "documents/completions", "out"] {
        fs::create_dir_all(place.path(folder)).expect("a folder");
    }
    let texts = ["README.md", "CHANGELOG.md", "LICENSE-MIT", "docs/administration.md", "docs/grafana/alerts.yaml"];
    for text in texts {
        fs::copy(root.join(text), source.join(text)).expect("copied");
    }
    fs::write(source.join("python/THIRD-PARTY-LICENCES.txt"), "").expect("written");
    for name in ["echolake.cdx.json", "man/echolake.1"] {
        fs::write(documents.join(name), "").expect("written");
    }
    for shell in ["bash", "zsh", "fish"] {
        fs::write(documents.join(format!("completions/echolake.{shell}")), "").expect("written");
    }
    // A small program that links libc alone stands for the command.
    let script = packaging().join("deb.sh");
    let mut command = Command::new("bash");
    command.arg(&script).args(["/bin/true", "amd64", "0.2.0"]).arg(&documents).arg(&source).arg(place.path("out"));
    let has_tools = run_command(Command::new("sh").args(["-c", "command -v dpkg-deb readelf gzip"]));
    if !has_tools.expect("a shell").status.success() {
        eprintln!("skipped: there is no dpkg-deb, readelf or gzip");
        return;
    }
    let made = run_command(&mut command).expect("it starts");
    assert!(made.status.success(), "{}", stderr(&made));
    let listed =
        run_command(Command::new("dpkg-deb").arg("--contents").arg(place.path("out/echolake_0.2.0_amd64.deb")));
    let listed = String::from_utf8(listed.expect("it starts").stdout).expect("text");
    let mode_of = |path: &str| listed.lines().find(|line| line.ends_with(path)).map(|line| &line[..10]);
    for unit in UNITS {
        assert_eq!(mode_of(&format!("./usr/lib/systemd/system/{unit}")), Some("-rw-r--r--"), "{unit} in {listed}");
    }
    for (path, mode) in [
        ("./usr/lib/systemd/system/echolake-doctor.service", "-rw-r--r--"),
        ("./usr/lib/systemd/system/echolake-backup.service", "-rw-r--r--"),
        ("./usr/lib/echolake/backup", "-rwxr-xr-x"),
        ("./usr/share/doc/echolake/grafana/alerts.yaml", "-rw-r--r--"),
    ] {
        assert_eq!(mode_of(path), Some(mode), "{path} in {listed}");
    }
}

#[test]
fn a_backup_copies_what_a_lake_is_made_from_or_says_why_not() {
    let place = TestFolder::new();
    let fake = place.path("bin");
    fs::create_dir_all(&fake).expect("a folder");
    // As much of rsync as shows what it is asked.
    let shown = "#!/bin/sh\nprintf '%s\\n' \"$@\"\n";
    fs::write(fake.join("rsync"), shown).expect("written");
    fs::set_permissions(fake.join("rsync"), fs::Permissions::from_mode(0o755)).expect("executable");
    let path = format!("{}:{}", fake.display(), std::env::var("PATH").unwrap_or_default());
    let backup = |lake: Option<&Path>, to: Option<&str>| {
        let mut command = Command::new(packaging().join("debian/backup"));
        command.env("PATH", &path).env_remove("ECHOLAKE_LAKE").env_remove("ECHOLAKE_BACKUP");
        command.envs(lake.map(|lake| ("ECHOLAKE_LAKE", lake.as_os_str())));
        command.envs(to.map(|to| ("ECHOLAKE_BACKUP", to)));
        let output = run_command(&mut command).expect("it starts");
        (output.status.success(), [&output.stdout[..], &output.stderr].concat())
    };
    let lake = place.path("lake");
    fs::create_dir_all(&lake).expect("a folder");
    let fails = |lake, to, expected: &str| {
        let (is_done, text) = backup(lake, to);
        let text = String::from_utf8_lossy(&text).into_owned();
        assert!(!is_done && text.contains(expected), "{text}");
    };
    fails(None, Some("/backup"), "ECHOLAKE_LAKE: is not set");
    fails(Some(&lake), None, "ECHOLAKE_BACKUP: is not set");
    fails(Some(&lake), Some(""), "ECHOLAKE_BACKUP: is not set");
    fails(Some(&lake), Some("/backup"), "no lake.toml");
    fs::write(lake.join("lake.toml"), "").expect("written");
    let (is_done, asked) = backup(Some(&lake), Some("host:/backup of lakes"));
    let asked = String::from_utf8(asked).expect("text");
    // What users add, and of the other tables nothing.
    let expected = format!(
        "-a\n--exclude\n*.partial\n--exclude\n/temp\n--include\n/tables/\n--include\n/tables/annotations/***\n\
         --include\n/tables/predictions/***\n--exclude\n/tables/*\n{}/\nhost:/backup of lakes/\n",
        lake.display()
    );
    assert!(is_done && asked == expected.repeat(2), "{asked}");
}

#[test]
fn a_release_keeps_what_the_advisories_said_or_fails() {
    let place = TestFolder::new();
    let database = place.path("cargo/advisory-dbs/advisory-db");
    let source = place.path("source");
    fs::create_dir_all(&database).expect("a folder");
    fs::create_dir_all(&source).expect("a folder");
    fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("deny.toml"), source.join("deny.toml")).expect("copied");
    let git = |args: &[&str]| {
        let names = ["-c", "user.name=a", "-c", "user.email=a@localhost"];
        let output = run_command(Command::new("git").arg("-C").arg(&database).args(names).args(args));
        let output = output.expect("git starts");
        assert!(output.status.success(), "{}", stderr(&output));
        String::from_utf8(output.stdout).expect("text").trim().to_owned()
    };
    git(&["init", "--quiet"]);
    git(&["commit", "--quiet", "--allow-empty", "--message", "An advisory"]);
    let commit = git(&["rev-parse", "HEAD"]);
    // As much of cargo-deny as answers: whether the database can be fetched, and what it finds.
    let fake = place.path("cargo-deny");
    let check = |fetched: bool, findings: &str, advisories: Option<&str>| {
        let found = i32::from(!findings.is_empty());
        let text = format!(
            "#!/bin/sh\ncase \"$*\" in *fetch*) exit {} ;; esac\necho '{findings}' >&2\nexit {found}\n",
            i32::from(!fetched)
        );
        fs::write(&fake, text).expect("written");
        fs::set_permissions(&fake, fs::Permissions::from_mode(0o755)).expect("executable");
        let mut command = Command::new(packaging().join("advisories.sh"));
        command.arg(&source).arg(place.path("advisories.txt")).env_remove("ECHOLAKE_ADVISORIES");
        command.env("CARGO_HOME", place.path("cargo")).env("ECHOLAKE_CARGO_DENY", &fake);
        command.envs(advisories.map(|advisories| ("ECHOLAKE_ADVISORIES", advisories)));
        let output = run_command(&mut command).expect("it starts");
        let written = fs::read_to_string(place.path("advisories.txt")).expect("a report");
        (output.status.success(), written, stderr(&output))
    };
    let (is_done, written, said) = check(true, "", None);
    assert!(is_done && written.contains(&format!("database: commit {commit} of 20")), "{written}{said}");
    // Every advisory that deny.toml answers is in the report, with its reason.
    let denied = fs::read_to_string(source.join("deny.toml")).expect("text");
    let answered = denied.matches("id = \"RUSTSEC-").count();
    assert!(answered > 0 && written.matches("\nRUSTSEC-").count() == answered, "{written}");
    assert!(written.contains("\nRUSTSEC-2026-0194: quick-xml 0.39"), "{written}");
    let (is_done, written, said) = check(true, "RUSTSEC-2026-9999", None);
    assert!(!is_done && written.contains("RUSTSEC-2026-9999") && said.contains("hint: update"), "{written}{said}");
    let (is_done, written, said) = check(false, "", None);
    assert!(!is_done && !written.contains("database:") && said.contains("ECHOLAKE_ADVISORIES=unchecked"), "{said}");
    let (is_done, written, said) = check(false, "", Some("unchecked"));
    assert!(is_done && written.contains("NOT CHECKED") && said.contains("NOT CHECKED"), "{written}{said}");
}
