//! Commands, answers and packets of a SeedLink connection.

use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::source_plan::SeedLinkVersion as Version;

/// Timeout of an answer to a command.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(30);
/// Time without a packet after which a connection counts as broken.
const PATIENCE: Duration = Duration::from_secs(120);
/// Maximum length of an answer in bytes.
const MAX_LINE_BYTES: u64 = 4096;
/// Size of the data of a packet in version 3.
const RECORD_BYTES: usize = 512;
/// Maximum size of the data of a packet in version 4. Records have at most some KiB.
const MAX_PAYLOAD_BYTES: usize = 1 << 20;

/// A packet with a miniSEED record.
#[derive(Debug)]
pub(super) struct Frame {
    pub(super) sequence: u64,
    pub(super) payload: Vec<u8>,
}

/// An error of a connection.
#[derive(Debug, thiserror::Error)]
pub(super) enum WireError {
    #[error("connection lost: {0}")]
    Io(std::io::Error),
    #[error("no answer within {} s", .0.as_secs())]
    Silent(Duration),
    #[error("the server closed the connection")]
    Closed,
    #[error("the server rejects {command}: {answer}")]
    Rejected { command: String, answer: String },
    #[error("no requested station is available")]
    NoStation,
    #[error("{what} is {found}, {allowed}")]
    Protocol {
        what: &'static str,
        found: String,
        allowed: &'static str,
    },
}

// Not a source, because the text contains it.
impl From<std::io::Error> for WireError {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

/// A connection to a server.
pub(super) struct Connection {
    stream: BufReader<TcpStream>,
}

impl Connection {
    pub(super) fn new(stream: TcpStream) -> Self {
        Self {
            stream: BufReader::new(stream),
        }
    }

    /// Greets the server and agrees on the version.
    pub(super) async fn hello(&mut self, newest: Version) -> Result<Version, WireError> {
        self.send("HELLO").await?;
        let software = self.line().await?;
        let _organization = self.line().await?;
        if newest == Version::Three || !software.contains("SLPROTO:4") {
            return Ok(Version::Three);
        }
        self.send("SLPROTO 4.0").await?;
        match self.line().await?.as_str() {
            "OK" => Ok(Version::Four),
            // A server that announces version 4 may refuse it to this client.
            _ => Ok(Version::Three),
        }
    }

    /// Sends a command and reads its answer.
    pub(super) async fn command(&mut self, command: &str) -> Result<(), WireError> {
        self.send(command).await?;
        match self.line().await? {
            answer if answer == "OK" => Ok(()),
            answer => Err(WireError::Rejected {
                command: command.to_owned(),
                answer: crate::lines::quoted(&answer),
            }),
        }
    }

    /// Starts the transfer. The server answers with packets.
    pub(super) async fn end(&mut self) -> Result<(), WireError> {
        self.send("END").await
    }

    async fn send(&mut self, command: &str) -> Result<(), WireError> {
        let line = format!("{command}\r\n");
        let sent = self.stream.get_mut().write_all(line.as_bytes());
        match timeout(ANSWER_TIMEOUT, sent).await {
            Ok(sent) => Ok(sent?),
            Err(_elapsed) => Err(WireError::Silent(ANSWER_TIMEOUT)),
        }
    }

    /// Reads an answer without its end.
    async fn line(&mut self) -> Result<String, WireError> {
        let mut bytes = Vec::new();
        let mut limited = (&mut self.stream).take(MAX_LINE_BYTES);
        let read = limited.read_until(b'\n', &mut bytes);
        match timeout(ANSWER_TIMEOUT, read).await {
            Err(_elapsed) => return Err(WireError::Silent(ANSWER_TIMEOUT)),
            Ok(Err(error)) => return Err(error.into()),
            Ok(Ok(0)) => return Err(WireError::Closed),
            Ok(Ok(_)) => {}
        }
        let line = String::from_utf8_lossy(&bytes);
        match line.ends_with('\n') {
            true => Ok(line.trim().to_owned()),
            false => Err(WireError::Protocol {
                what: "answer",
                found: crate::lines::quoted(&line),
                allowed: "must be a line of at most 4096 bytes",
            }),
        }
    }

    /// Reads the next packet. Returns `None` for a packet without samples.
    pub(super) async fn frame(&mut self, version: Version) -> Result<Option<Frame>, WireError> {
        match version {
            Version::Three => self.frame_3().await,
            Version::Four => self.frame_4().await,
        }
    }

    /// Reads `SL`, six hexadecimal digits and a record of 512 bytes.
    async fn frame_3(&mut self) -> Result<Option<Frame>, WireError> {
        let mut head = [0; 8];
        self.fill(&mut head).await?;
        let text = String::from_utf8_lossy(&head).into_owned();
        let Some(number) = text.strip_prefix("SL") else {
            return Err(header_fault(&text));
        };
        let mut payload = vec![0; RECORD_BYTES];
        if number.starts_with("INFO") {
            self.fill(&mut payload).await?;
            return Ok(None);
        }
        let sequence = u64::from_str_radix(number, 16).map_err(|_| header_fault(&text))?;
        self.fill(&mut payload).await?;
        Ok(Some(Frame { sequence, payload }))
    }

    /// Reads `SE`, format, subformat, length, sequence number, station and data.
    async fn frame_4(&mut self) -> Result<Option<Frame>, WireError> {
        let mut head = [0; 17];
        self.fill(&mut head).await?;
        let [
            s,
            e,
            format,
            subformat,
            l0,
            l1,
            l2,
            l3,
            sequence @ ..,
            id_length,
        ] = head;
        if [s, e] != *b"SE" {
            return Err(header_fault(&String::from_utf8_lossy(&head)));
        }
        let length = u32::from_le_bytes([l0, l1, l2, l3]) as usize;
        if length > MAX_PAYLOAD_BYTES {
            return Err(WireError::Protocol {
                what: "length of a packet",
                found: length.to_string(),
                allowed: "must be at most 1048576 bytes",
            });
        }
        let mut id = vec![0; usize::from(id_length)];
        self.fill(&mut id).await?;
        let mut payload = vec![0; length];
        self.fill(&mut payload).await?;
        // Format 2 or 3 is miniSEED of that version; subformat D is data.
        let has_samples = matches!(format, b'2' | b'3') && subformat == b'D';
        Ok(has_samples.then_some(Frame {
            sequence: u64::from_le_bytes(sequence),
            payload,
        }))
    }

    async fn fill(&mut self, bytes: &mut [u8]) -> Result<(), WireError> {
        match timeout(PATIENCE, self.stream.read_exact(bytes)).await {
            Err(_elapsed) => Err(WireError::Silent(PATIENCE)),
            Ok(Err(error)) if error.kind() == std::io::ErrorKind::UnexpectedEof => {
                Err(WireError::Closed)
            }
            Ok(Err(error)) => Err(error.into()),
            Ok(Ok(_)) => Ok(()),
        }
    }
}

fn header_fault(found: &str) -> WireError {
    WireError::Protocol {
        what: "header of a packet",
        found: crate::lines::quoted(found),
        allowed: "must start with SL (version 3) or SE (version 4)",
    }
}
