//! A run that breaks off posts a notice, and a notice that cannot be sent changes nothing.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpListener;
use std::process::Command;
use std::thread;

use crate::{ECHOLAKE, TestFolder, run_command, stderr};

const PAIRS: f64 = 45.0;

// Its file may have no more than 5.12 MB, of 5.47: the system refuses the next write.
fn acquire_into_a_small_file(place: &TestFolder, url: &str) -> (Option<i32>, String) {
    let script = format!(
        "trap '' XFSZ; ulimit -f 10000; exec {ECHOLAKE} --lake lake acquire --surface flat --rig rig.toml \
         --checkpoint-every 1 --notify {url}"
    );
    let mut command = Command::new("sh");
    command.args(["-c", &script]).current_dir(place.path("")).env("NO_PROXY", "127.0.0.1");
    let output = run_command(&mut command).expect("a shell");
    (output.status.code(), stderr(&output))
}

// Answers one request, and returns its body.
fn receive_notice(listener: TcpListener, answer: String) -> thread::JoinHandle<Vec<u8>> {
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().expect("a notice");
        let mut reader = BufReader::new(stream.try_clone().expect("a stream"));
        let mut length = 0;
        let mut line = String::new();
        while reader.read_line(&mut line).expect("a line") > 2 {
            if let Some(number) = line.to_lowercase().strip_prefix("content-length: ") {
                length = number.trim().parse().expect("a number");
            }
            line.clear();
        }
        let mut body = vec![0; length];
        reader.read_exact(&mut body).expect("a body");
        stream.write_all(format!("HTTP/1.1 {answer}\r\n\r\n").as_bytes()).expect("answered");
        body
    })
}

/// E23: a notice is for the host that the user named.
#[test]
fn a_notice_follows_no_redirect_to_another_host() {
    let place = TestFolder::new();
    let [named, other] = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").expect("a port"));
    let url = format!("http://{}/hook?secret=7", named.local_addr().expect("an address"));
    let port = other.local_addr().expect("an address").port();
    let redirect = format!("307 Temporary Redirect\r\nLocation: http://localhost:{port}/hook\r\nContent-Length: 0");
    let receiver = receive_notice(named, redirect);
    let (code, said) = acquire_into_a_small_file(&place, &url);
    assert_eq!(code, Some(1), "{said}");
    receiver.join().expect("a notice");
    let expected = "warning: the notice was not sent to 127.0.0.1: ";
    assert!(said.contains(expected) && said.contains("it is redirected to localhost"), "{said}");
    assert!(!said.contains("secret"), "{said}");
    other.set_nonblocking(true).expect("a listener");
    assert!(other.accept().is_err(), "nobody connects to the other host");
}

#[test]
fn a_run_that_breaks_off_posts_a_notice() {
    let place = TestFolder::new();
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
    let url = format!("http://{}/hook?secret=7", listener.local_addr().expect("an address"));
    let receiver = receive_notice(listener, "204 No Content".to_owned());
    let (code, said) = acquire_into_a_small_file(&place, &url);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("aborted") && !said.contains("warning: the notice"), "{said}");
    let notice: serde_json::Value = serde_json::from_slice(&receiver.join().expect("a notice")).expect("JSON");
    assert_eq!(notice["event"], "run_broken_off", "{notice}");
    assert_eq!(notice["surface"], "flat");
    assert_eq!(notice["simulated"], true);
    assert_eq!(notice["pairs"].as_f64(), Some(PAIRS));
    let accepted = notice["accepted"].as_f64().expect("a number");
    assert!(accepted > 0.0 && accepted < PAIRS, "{notice}");
    assert!(notice["error"].as_str().is_some_and(|error| said.contains(error)), "{notice} {said}");
    let file = notice["file"].as_str().expect("a file");
    assert!(file.ends_with(".mcap.partial") && place.path(file).exists(), "{notice}");
    // Nobody listens there any more.
    let (code, said) = acquire_into_a_small_file(&place, &url);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("warning: the notice was not sent to 127.0.0.1: ") && !said.contains("secret"), "{said}");
    place.fails(2, &["acquire", "--surface", "flat", "--notify", "ftp://host/"], "`ftp` is not http or https");
}
