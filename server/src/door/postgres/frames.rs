//! Messages of Postgres' protocol as the door sees them: a type, a length, bytes. Their contents are the engine's.

use bytes::{Buf as _, BufMut as _, BytesMut};
use echolake_service::RequestFault;

/// Bytes of a message's type and length.
pub(super) const HEADER: usize = 5;
/// Bytes of a text with its name and types.
const TEXT: usize = (2 << 20) + (1 << 10);
/// Bytes of the values of a statement.
const VALUES: usize = 4 << 20;
/// Bytes of what only names a statement or a portal.
const NAMES: usize = 4 << 10;
/// Of a password.
const PASSWORD: usize = 18 << 10;

/// The first bytes of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FrameHeader {
    pub kind: u8,
    /// Bytes of the whole message, with these.
    pub bytes: usize,
}

impl FrameHeader {
    /// Reads it from the beginning of a buffer; None until there is enough.
    ///
    /// # Errors
    /// [`RequestFault::Request`] if the length is impossible.
    pub fn peek_from(buffer: &[u8]) -> Result<Option<Self>, RequestFault> {
        let Some((&[kind, a, b, c, d], _)) = buffer.split_first_chunk() else { return Ok(None) };
        match i32::from_be_bytes([a, b, c, d]) {
            length @ 4.. => Ok(Some(Self { kind, bytes: length.unsigned_abs() as usize + 1 })),
            length => Err(RequestFault::bad_request(format!("a message of {length} bytes; a length is 4 at least"))),
        }
    }

    /// Checks a client's message before anything of it is kept.
    ///
    /// # Errors
    /// [`RequestFault::TooLarge`], [`RequestFault::Request`].
    pub fn check_header(self) -> Result<(), RequestFault> {
        let limit = match self.kind {
            b'Q' | b'P' => TEXT,
            b'B' => VALUES,
            b'p' => PASSWORD,
            b'D' | b'C' | b'E' | b'H' | b'S' | b'X' | b'c' | b'f' | b'd' | b'F' => NAMES,
            other => {
                return Err(RequestFault::bad_request(format!("a message of the type {other:#04x}, which is none")));
            }
        };
        match self.bytes <= limit {
            true => Ok(()),
            false => Err(RequestFault::TooLarge { limit }),
        }
    }

    /// Checks that the parts of a client's message, all of which is there, are within it: the library that decodes it
    /// panics if they are not.
    ///
    /// # Errors
    /// [`RequestFault::Request`].
    pub fn check_parts(self, message: &[u8]) -> Result<(), RequestFault> {
        let body = message.get(HEADER..).unwrap_or_default();
        let kind = char::from(self.kind);
        let wrong =
            || RequestFault::bad_request(format!("a message of the type `{kind}` that ends before its last part"));
        MessageParts(body).skip_all(self.kind).ok_or_else(wrong)
    }
}

/// The rest of a message's body.
struct MessageParts<'a>(&'a [u8]);

impl MessageParts<'_> {
    fn skip_all(mut self, kind: u8) -> Option<()> {
        match kind {
            b'Q' => self.skip_text(),
            b'D' | b'C' => {
                self.skip_bytes(1)?;
                self.skip_text()
            }
            b'E' => {
                self.skip_text()?;
                self.skip_bytes(4)
            }
            b'P' => {
                self.skip_text()?;
                self.skip_text()?;
                self.skip_numbers(4)
            }
            b'B' => {
                self.skip_text()?;
                self.skip_text()?;
                self.skip_numbers(2)?;
                for _ in 0..self.0.try_get_u16().ok()? {
                    // A negative length is that of a null.
                    let bytes = usize::try_from(self.0.try_get_i32().ok()?).unwrap_or(0);
                    self.skip_bytes(bytes)?;
                }
                self.skip_numbers(2)
            }
            _ => Some(()),
        }
    }

    // Up to and with the zero byte.
    fn skip_text(&mut self) -> Option<()> {
        let end = self.0.iter().position(|byte| *byte == 0)?;
        self.skip_bytes(end + 1)
    }

    // A count, and so many numbers.
    fn skip_numbers(&mut self, bytes_each: usize) -> Option<()> {
        let count = self.0.try_get_u16().ok()?;
        self.skip_bytes(usize::from(count) * bytes_each)
    }

    fn skip_bytes(&mut self, bytes: usize) -> Option<()> {
        self.0 = self.0.get(bytes..)?;
        Some(())
    }
}

/// Requests a password.
pub(super) const PASSWORD_WANTED: [u8; 9] = [b'R', 0, 0, 0, 8, 0, 0, 0, 3];

/// Encodes a cancel key for the client.
pub(super) fn key_message(pid: i32, secret: &[u8]) -> BytesMut {
    let mut bytes = BytesMut::new();
    bytes.put_u8(b'K');
    bytes.put_i32(8 + i32::try_from(secret.len()).unwrap_or(0));
    bytes.put_i32(pid);
    bytes.put_slice(secret);
    bytes
}

/// Encodes a request to cancel the query on the connection of this key.
pub(super) fn cancel_message(pid: i32, secret: &[u8]) -> BytesMut {
    let mut bytes = BytesMut::new();
    bytes.put_i32(12 + i32::try_from(secret.len()).unwrap_or(0));
    bytes.put_i32(CANCEL);
    bytes.put_i32(pid);
    bytes.put_slice(secret);
    bytes
}

/// Request codes in the place of a startup packet's protocol version.
const CANCEL: i32 = 80_877_102;
const TLS: i32 = 80_877_103;
const GSS: i32 = 80_877_104;

/// The content of a client's first packet.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum StartupPacket {
    /// It asks for encryption, by TLS or by GSSAPI.
    Encryption { is_tls: bool },
    /// It cancels the query of another connection.
    Cancel { pid: i32, secret: Vec<u8> },
    /// It begins a session, as this user.
    Session { user: String },
}

impl StartupPacket {
    /// Reads the packet behind its length.
    ///
    /// # Errors
    /// [`RequestFault::Request`].
    pub fn parse(mut packet: &[u8]) -> Result<Self, RequestFault> {
        let wrong = || RequestFault::bad_request("the protocol's startup is expected");
        match packet.try_get_i32().map_err(|_| wrong())? {
            TLS => Ok(Self::Encryption { is_tls: true }),
            GSS => Ok(Self::Encryption { is_tls: false }),
            CANCEL => {
                let pid = packet.try_get_i32().map_err(|_| wrong())?;
                Ok(Self::Cancel { pid, secret: packet.to_vec() })
            }
            version if version >> 16 == 3 => {
                let mut texts = packet.split(|byte| *byte == 0).map(String::from_utf8_lossy);
                let mut user = String::new();
                while let (Some(name), Some(value)) = (texts.next(), texts.next()) {
                    if name == "user" {
                        user = value.into_owned();
                    }
                }
                Ok(Self::Session { user })
            }
            _ => Err(wrong()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_are_checked_before_anything_is_kept() {
        let header = |kind: u8, length: i32| {
            let mut bytes = vec![kind];
            bytes.extend(length.to_be_bytes());
            FrameHeader::peek_from(&bytes)
        };
        assert_eq!(FrameHeader::peek_from(b"Q\0\0\0").expect("no harm"), None);
        for length in [i32::MIN, -1, 0, 3] {
            assert!(header(b'Q', length).is_err(), "{length}");
        }
        let check = |kind, length| header(kind, length).expect("a length").expect("whole").check_header();
        assert!(check(b'Q', 2 << 20).is_ok() && check(b'B', 4 << 20).is_err() && check(b'S', 4).is_ok());
        for (kind, length) in [(b'Q', 0x3fff_fff0), (b'P', i32::MAX), (b'E', 5000), (b'!', 4), (b'd', 1 << 20)] {
            assert!(check(kind, length).is_err(), "{kind} {length}");
        }
    }

    #[test]
    fn a_message_that_ends_early_is_refused() {
        let parse = b"s\0select $1, $2\0\0\x02\0\0\0\x17\0\0\0\x17";
        let bind = b"p\0s\0\0\x01\0\x01\0\x02\0\0\0\x01x\xff\xff\xff\xff\0\x01\0\x01";
        for (kind, body) in [
            (b'Q', &b"select 1\0"[..]),
            (b'D', b"Ss\0"),
            (b'C', b"Pp\0"),
            (b'E', b"p\0\0\0\0\x02"),
            (b'P', parse),
            (b'B', bind),
        ] {
            let check = |body: &[u8]| {
                let message = [&[kind, 0, 0, 0, 0], body].concat();
                FrameHeader { kind, bytes: message.len() }.check_parts(&message)
            };
            assert!(check(body).is_ok(), "{kind}");
            for end in 0..body.len() {
                assert!(check(&body[..end]).is_err(), "{kind} {end}");
            }
        }
    }

    #[test]
    fn startups_are_told_apart() {
        let packet = |code: i32, rest: &[u8]| [&code.to_be_bytes(), rest].concat();
        assert_eq!(StartupPacket::parse(&packet(TLS, b"")).expect("known"), StartupPacket::Encryption { is_tls: true });
        let session = StartupPacket::parse(&packet(3 << 16, b"database\0x\0user\0ann\0\0")).expect("known");
        assert_eq!(session, StartupPacket::Session { user: "ann".to_owned() });
        let cancel = StartupPacket::parse(&cancel_message(7, b"abcd")[4..]).expect("known");
        assert_eq!(cancel, StartupPacket::Cancel { pid: 7, secret: b"abcd".to_vec() });
        for wrong in [&b""[..], b"\0\0", &packet(2 << 16, b""), &packet(-1, b"x")] {
            assert!(StartupPacket::parse(wrong).is_err(), "{wrong:?}");
        }
    }
}
