//! One client of a server, on a thread of its own.
#![expect(clippy::result_large_err, reason = "tungstenite's own type")]

use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tungstenite::http::{HeaderValue, StatusCode};
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, WebSocket};

use super::access::{AccessCheck, refusal_response};
use super::handshakes::{LONGEST_HANDSHAKE, TimedStream};
use super::protocol::{self, ClientRequest};
use super::queue::OutgoingItem;
use super::{ClientQueue, ViewerState};

/// Timeout of one wait for the client's messages.
const LOOKS: Duration = Duration::from_millis(10);
/// Timeout of writes: a client that reads nothing for so long is disconnected.
const PATIENCE: Duration = Duration::from_secs(10);
/// Limit of a client's message, bytes: requests are short.
const LARGEST_WISH: usize = 1 << 20;

/// Serves a client, whose handshake is pending, until it or the server is gone.
pub(super) fn serve_client(stream: Arc<TcpStream>, shared: &ViewerState) {
    // After any error here the client is disconnected, and may connect again.
    let shaken = shake_hands(stream.clone(), shared);
    shared.handshakes.remove(&stream);
    drop(stream);
    let Ok(shaken) = shaken else { return };
    let Some(queue) = shared.add_client() else { return };
    let _ = exchange_messages(shaken, shared, &queue);
    shared.remove_client(&queue);
}

fn answer_handshake(
    access: &AccessCheck,
    request: &Request,
    mut response: Response,
) -> Result<Response, ErrorResponse> {
    access.check_request(request)?;
    let offered = request.headers().get_all("Sec-WebSocket-Protocol").iter().filter_map(|v| v.to_str().ok());
    match protocol::choose_subprotocol(offered) {
        Some(chosen) => {
            response.headers_mut().insert("Sec-WebSocket-Protocol", HeaderValue::from_static(chosen));
            Ok(response)
        }
        None => Err(refusal_response(StatusCode::BAD_REQUEST, "open this address in Foxglove\n".to_owned())),
    }
}

fn shake_hands(
    stream: Arc<TcpStream>,
    shared: &ViewerState,
) -> Result<WebSocket<TimedStream>, Box<dyn std::error::Error>> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let config = WebSocketConfig::default().max_message_size(Some(LARGEST_WISH)).max_frame_size(Some(LARGEST_WISH));
    let choose = |request: &Request, response: Response| answer_handshake(&shared.access, request, response);
    let stream = TimedStream::new(stream, LONGEST_HANDSHAKE);
    let mut socket = tungstenite::accept_hdr_with_config(stream, choose, Some(config)).map_err(|e| e.to_string())?;
    socket.get_mut().lift_deadline();
    socket.get_ref().stream.set_read_timeout(Some(LOOKS))?;
    Ok(socket)
}

fn exchange_messages(
    mut socket: WebSocket<TimedStream>,
    shared: &ViewerState,
    queue: &Arc<ClientQueue>,
) -> Result<(), Box<dyn std::error::Error>> {
    socket.send(Message::text(protocol::server_info(&shared.clock)))?;
    socket.send(Message::text(protocol::advertise_channels(&shared.topics())))?;
    while !shared.has_ended() {
        handle_request(&mut socket, shared, queue)?;
        while let Some(outgoing) = queue.pop() {
            socket.write(Message::binary(match outgoing {
                OutgoingItem::Message(subscription, message) => {
                    protocol::message_data(subscription, message.log_time_nanos, &message.data)
                }
                OutgoingItem::Time(nanos) => protocol::time_message(nanos),
                OutgoingItem::State(encoded) => encoded,
            }))?;
        }
        socket.flush()?;
    }
    // The last messages are still delivered.
    socket.close(None)?;
    Ok(socket.flush()?)
}

fn handle_request(
    socket: &mut WebSocket<TimedStream>,
    shared: &ViewerState,
    queue: &Arc<ClientQueue>,
) -> Result<(), tungstenite::Error> {
    let wish = match socket.read() {
        Ok(Message::Text(text)) => protocol::parse_request(&text),
        Ok(Message::Binary(bytes)) => protocol::playback_request(&bytes).map(ClientRequest::Playback),
        Ok(_) => None,
        Err(tungstenite::Error::Io(e))
            if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) =>
        {
            None
        }
        Err(error) => return Err(error),
    };
    match wish {
        Some(ClientRequest::Subscribe(wishes)) => shared.subscribe_client(queue, &wishes),
        Some(ClientRequest::Unsubscribe(ids)) => shared.unsubscribe_client(queue, &ids),
        Some(ClientRequest::Playback(request)) => shared.control_playback(queue, request),
        None => {}
    }
    Ok(())
}
