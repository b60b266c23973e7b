//! Clients with different rights on one server: each gets the answers that it gets on a server that it has for itself,
//! whatever others have asked before, and whichever of their tags it shows.

use std::collections::BTreeMap;

use super::super::http::{HttpRequest, HttpResponse};
use super::super::served;
use super::super::server::ServedLake;
use super::{addresses, check_marks, new_token, with_and_without};
use crate::TestFolder;
use crate::serve::projects::ProjectScene;

/// Five tokens, by name, their scopes and options.
const TOKENS: [(&str, &str, &[&str]); 5] = [
    ("all", "[\"sql\", \"files\", \"annotate\", \"metrics\"]", &[]),
    ("reader", "[\"sql\"]", &[]),
    ("files", "[\"files\"]", &[]),
    ("ours", "[\"sql\", \"files\", \"annotate\"]", &["--project", "ours"]),
    ("theirs", "[\"sql\", \"files\"]", &["--project", "theirs"]),
];

/// A client: one of the tokens, or none.
struct SharingClient {
    name: &'static str,
    token: Option<String>,
}

/// What a client gets: status, tag and body.
type ClientAnswer = (u16, Option<String>, Vec<u8>);

fn make_clients(place: &TestFolder) -> Vec<SharingClient> {
    let mut file = String::new();
    let mut clients = vec![SharingClient { name: "nobody", token: None }];
    for (name, scopes, options) in TOKENS {
        let (token, lines) = new_token(place, &[&[name], options].concat());
        file += &lines.replace("[\"sql\", \"files\"]", scopes);
        clients.push(SharingClient { name, token: Some(token) });
    }
    std::fs::write(place.path("tokens.toml"), file).expect("written");
    clients
}

fn ask(server: &ServedLake, client: &SharingClient, path: &str, tag: Option<&str>) -> HttpResponse {
    // Addresses in answers, and their tags, have the name by which the client asked.
    let mut request = HttpRequest::get(path).host("localhost");
    if let Some(token) = &client.token {
        request = request.with("authorization", &format!("Bearer {token}"));
    }
    if let Some(tag) = tag {
        request = request.with("if-none-match", tag);
    }
    request.send(server)
}

fn answer_of(response: &HttpResponse) -> ClientAnswer {
    (response.status, response.header("etag").map(str::to_owned), response.body.clone())
}

mod slow {
    use super::*;

    #[test]
    fn clients_that_share_engines_get_their_own_answers() {
        let [_, with] = with_and_without();
        let scene = ProjectScene::serve(with);
        let (marks, hidden) = (scene.marks(), scene.hidden());
        let file = "select path from system.files where \"table\" = 'nce' and surface_id = 'wood_secret'";
        let file = scene.place.sql(file);
        let file = file[0]["path"].as_str().expect("a path").rsplit('/').next().expect("a name").to_owned();
        let place = scene.place;
        drop(scene.server);
        let clients = make_clients(&place);
        let paths = addresses(&hidden, &file);
        // Each client alone, on a server of its own.
        let mut alone = BTreeMap::new();
        for client in &clients {
            let server = served(&place, &["--tokens", "tokens.toml"]);
            for path in &paths {
                alone.insert((client.name, path.as_str()), answer_of(&ask(&server, client, path, None)));
            }
        }
        let is_seen = |name, path: &String| alone[&(name, path.as_str())].0 == 200;
        assert!(paths.iter().all(|path| is_seen("all", path)), "whoever may see all sees all");
        assert!(!paths.iter().any(|path| is_seen("nobody", path)));
        // All of them on one, in another order for each path, with each other's tags and without.
        let server = served(&place, &["--tokens", "tokens.toml"]);
        let mut requests = 0;
        for (number, path) in paths.iter().enumerate() {
            let tags: Vec<_> = clients.iter().map(|client| alone[&(client.name, path.as_str())].1.clone()).collect();
            for place in 0..clients.len() {
                let client = &clients[(place + number) % clients.len()];
                let (status, own_tag, body) = &alone[&(client.name, path.as_str())];
                for tag in std::iter::once(&None).chain(&tags) {
                    let answer = ask(&server, client, path, tag.as_deref());
                    requests += 1;
                    let about = format!("{} {path} {tag:?}", client.name);
                    if tag.is_some() && tag == own_tag && *status == 200 {
                        assert_eq!((answer.status, answer.body.len()), (304, 0), "{about}");
                        continue;
                    }
                    assert_eq!((answer.status, answer.header("etag")), (*status, own_tag.as_deref()), "{about}");
                    assert!(answer.body == *body, "{about}: {} and alone {} bytes", answer.body.len(), body.len());
                }
                if client.name == "ours" {
                    check_marks(&marks, path, &String::from_utf8_lossy(body));
                }
            }
        }
        assert!(requests > 1_060, "{requests}");
    }
}
