//! One client of a server, on a thread of its own.

use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use tungstenite::handshake::server::{Request, Response};
use tungstenite::http::{HeaderValue, StatusCode};
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, WebSocket};

use super::protocol::{self, Wish};
use super::queue::Outgoing;
use super::{Queue, Shared};

/// How often it is looked whether the client says something.
const LOOKS: Duration = Duration::from_millis(10);
/// A client that takes nothing for so long is gone.
const PATIENCE: Duration = Duration::from_secs(10);
/// What a client says is short.
const LARGEST_WISH: usize = 1 << 20;

/// Serves a client until it or the server is gone.
pub(super) fn serve(stream: TcpStream, shared: &Shared, queue: &Arc<Queue>) {
    // Whatever goes wrong here, the client is gone, and comes again if it likes.
    let _ = talk(stream, shared, queue);
}

#[expect(clippy::result_large_err, reason = "tungstenite's own type")]
fn choose(
    request: &Request,
    mut response: Response,
) -> Result<Response, tungstenite::handshake::server::ErrorResponse> {
    let offered = request.headers().get_all("Sec-WebSocket-Protocol").iter().filter_map(|v| v.to_str().ok());
    match protocol::choose(offered) {
        Some(chosen) => {
            response.headers_mut().insert("Sec-WebSocket-Protocol", HeaderValue::from_static(chosen));
            Ok(response)
        }
        None => {
            let mut refused =
                tungstenite::handshake::server::ErrorResponse::new(Some("open this address in Foxglove\n".into()));
            *refused.status_mut() = StatusCode::BAD_REQUEST;
            Err(refused)
        }
    }
}

fn talk(stream: TcpStream, shared: &Shared, queue: &Arc<Queue>) -> Result<(), Box<dyn std::error::Error>> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let config = WebSocketConfig::default().max_message_size(Some(LARGEST_WISH)).max_frame_size(Some(LARGEST_WISH));
    let mut socket = tungstenite::accept_hdr_with_config(stream, choose, Some(config)).map_err(|e| e.to_string())?;
    socket.get_ref().set_read_timeout(Some(LOOKS))?;
    socket.send(Message::text(protocol::server_info(shared.playback.as_ref().map(|p| p.range))))?;
    socket.send(Message::text(protocol::advertise(&shared.topics())))?;
    while !shared.has_ended() {
        listen(&mut socket, shared, queue)?;
        while let Some(outgoing) = queue.pop() {
            socket.write(Message::binary(match outgoing {
                Outgoing::Message(subscription, message) => {
                    protocol::message_data(subscription, message.log_time_nanos, &message.data)
                }
                Outgoing::Time(nanos) => protocol::time(nanos),
                Outgoing::State(encoded) => encoded,
            }))?;
        }
        socket.flush()?;
    }
    // What came last is still shown.
    socket.close(None)?;
    Ok(socket.flush()?)
}

fn listen(socket: &mut WebSocket<TcpStream>, shared: &Shared, queue: &Arc<Queue>) -> Result<(), tungstenite::Error> {
    let wish = match socket.read() {
        Ok(Message::Text(text)) => protocol::wish(&text),
        Ok(Message::Binary(bytes)) => protocol::playback_request(&bytes).map(Wish::Playback),
        Ok(_) => None,
        Err(tungstenite::Error::Io(e))
            if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) =>
        {
            None
        }
        Err(error) => return Err(error),
    };
    match wish {
        Some(Wish::Subscribe(wishes)) => shared.subscribe(queue, &wishes),
        Some(Wish::Unsubscribe(ids)) => shared.unsubscribe(queue, &ids),
        Some(Wish::Playback(request)) => shared.control(queue, request),
        None => {}
    }
    Ok(())
}
