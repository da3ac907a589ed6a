//! Parser of Python literals: numbers, strings, lists, tuples, dictionaries, True, False, None.

use std::fmt;
use std::ops::Range;
use std::path::Path;

use crate::error::{Error, quoted};

/// Maximum nesting depth of a literal. The parser recurses, so each level takes space on the call stack.
const MAX_DEPTH: usize = 32;
/// Escape sequences of a backslash and one character, each with the character that it stands for.
const ESCAPES: [(char, char); 6] = [('n', '\n'), ('t', '\t'), ('r', '\r'), ('\\', '\\'), ('\'', '\''), ('"', '"')];

/// Parsed Python literal, or text that is no literal.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Literal {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(String),
    /// List or tuple, with its elements.
    Sequence(Vec<Literal>),
    Dict(Vec<(Literal, Literal)>),
    /// Text that is not a Python literal, such as `device(type='cuda')` or `PosixPath('x')`. Its brackets are balanced.
    Opaque(String),
}

impl fmt::Display for Literal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Literal::None => write!(f, "None"),
            Literal::Bool(true) => write!(f, "True"),
            Literal::Bool(false) => write!(f, "False"),
            Literal::Int(value) => write!(f, "{value}"),
            Literal::Float(value) => write!(f, "{value}"),
            Literal::Str(value) => write!(f, "the string {}", quoted(value)),
            Literal::Sequence(items) => write!(f, "a list of {}", items.len()),
            Literal::Dict(entries) => write!(f, "a dictionary of {}", entries.len()),
            Literal::Opaque(text) => write!(f, "`{}`", text.chars().take(40).collect::<String>()),
        }
    }
}

/// Keyword argument `key=value` of a call.
#[derive(Debug)]
pub(crate) struct Argument {
    pub(crate) name: String,
    pub(crate) value: Literal,
    /// Byte range, in the parsed text, of the argument's value.
    pub(crate) place: Range<usize>,
}

/// Parse error: byte offset in the text at which parsing stopped, and a description of the token expected there.
#[derive(Debug, PartialEq)]
pub(crate) struct ParseError {
    byte: usize,
    expected: &'static str,
}

impl ParseError {
    /// Converts the parse error into an error about the file at `path`, whose content is `text`.
    pub(crate) fn in_file(self, path: &Path, text: &str) -> Error {
        let before = &text[..self.byte];
        let line = 1 + before.matches('\n').count();
        let rest = &text[self.byte..];
        let found = if rest.is_empty() {
            "the end of the file".to_owned()
        } else {
            format!("`{}`", rest.chars().take(20).collect::<String>().escape_debug())
        };
        Error::input(path, format!("line {line}, byte {}", self.byte), self.expected, found)
    }
}

type Parsed<T> = std::result::Result<T, ParseError>;

/// Parses `text`, which must be the call `NAME(key=value, …)` with `name` as NAME. Returns its keyword arguments in
/// order.
pub(crate) fn parse_call(text: &str, name: &'static str) -> Parsed<Vec<Argument>> {
    let mut parser = Parser { text, at: 0 };
    parser.skip_space();
    if !parser.take(name) {
        return Err(parser.error("Namespace(…)"));
    }
    parser.expect("(", "`(`")?;
    let mut keys = Vec::new();
    while !parser.take_token(")") {
        let key = parser.word();
        if key.is_empty() {
            return Err(parser.error("a key or `)`"));
        }
        parser.expect("=", "`=`")?;
        parser.skip_space();
        let start = parser.at;
        let value = parser.value(0)?;
        let place = start..start + text[start..parser.at].trim_end().len();
        keys.push(Argument { name: key.to_owned(), value, place });
        if !parser.take_token(",") && !parser.rest().trim_start().starts_with(')') {
            return Err(parser.error("`,` or `)`"));
        }
    }
    parser.skip_space();
    if parser.rest().is_empty() { Ok(keys) } else { Err(parser.error("nothing after the closing `)`")) }
}

struct Parser<'a> {
    text: &'a str,
    /// Present position of the parser: byte offset in the text of the next character, always at a character boundary.
    at: usize,
}

impl<'a> Parser<'a> {
    /// Returns the text that has not been parsed yet.
    fn rest(&self) -> &'a str {
        &self.text[self.at..]
    }

    /// Returns a parse error at the present position of the parser. `expected` describes what should be there.
    fn error(&self, expected: &'static str) -> ParseError {
        ParseError { byte: self.at, expected }
    }

    /// Skips white space.
    fn skip_space(&mut self) {
        self.at = self.text.len() - self.rest().trim_start().len();
    }

    /// Skips `token` if the text continues with it, and returns whether it does.
    fn take(&mut self, token: &str) -> bool {
        let found = self.rest().starts_with(token);
        if found {
            self.at += token.len();
        }
        found
    }

    /// Skips white space. Then skips `token` if the text continues with it, and returns whether it does.
    fn take_token(&mut self, token: &str) -> bool {
        self.skip_space();
        self.take(token)
    }

    /// Skips white space and then `token`. Fails if anything other than `token` comes next; `expected` describes
    /// `token` in the error.
    fn expect(&mut self, token: &str, expected: &'static str) -> Parsed<()> {
        if self.take_token(token) { Ok(()) } else { Err(self.error(expected)) }
    }

    /// Skips white space, then reads a name, keyword or number: the longest run of letters, digits and `_ . + -`.
    /// Returns it; empty if another character comes first.
    fn word(&mut self) -> &'a str {
        self.skip_space();
        let rest = self.rest();
        let end = rest.find(|c: char| !(c.is_alphanumeric() || "_.+-".contains(c))).unwrap_or(rest.len());
        self.at += end;
        &rest[..end]
    }

    /// Parses a value, such as an element of a list, up to the next separator (comma, colon or closing bracket).
    /// `depth` is the number of brackets open around it. If the text up to the separator is no Python literal, it
    /// becomes [`Literal::Opaque`]. Fails if `depth` is more than 32, or if a bracket or quote is missing.
    fn value(&mut self, depth: usize) -> Parsed<Literal> {
        self.skip_space();
        let start = self.at;
        if depth > MAX_DEPTH {
            return Err(self.error("at most 32 levels of nesting"));
        }
        match self.literal(depth) {
            Ok(Some(literal)) if self.at_separator() => Ok(literal),
            // Return errors from inside the value: treating the text as opaque would hide where the error is.
            Err(error) => Err(error),
            Ok(_) => {
                self.at = start;
                self.skip_balanced()?;
                match self.text[start..self.at].trim() {
                    "" => Err(self.error("a value")),
                    text => Ok(Literal::Opaque(text.to_owned())),
                }
            }
        }
    }

    /// Skips white space. Returns whether a value has ended: a comma, a colon, a closing bracket or the end of the text
    /// comes next.
    fn at_separator(&mut self) -> bool {
        self.skip_space();
        matches!(self.rest().chars().next(), None | Some(',' | ')' | ']' | '}' | ':'))
    }

    /// Parses a Python literal. `depth` is the number of brackets open around it. Returns `None` if the text does not
    /// continue with a literal.
    fn literal(&mut self, depth: usize) -> Parsed<Option<Literal>> {
        Ok(match self.rest().chars().next() {
            Some('\'' | '"') => Some(Literal::Str(self.string()?)),
            Some('[') => Some(Literal::Sequence(self.sequence("]", depth)?)),
            Some('(') => Some(Literal::Sequence(self.sequence(")", depth)?)),
            Some('{') => self.dict(depth)?,
            _ => match self.word() {
                "None" => Some(Literal::None),
                "True" => Some(Literal::Bool(true)),
                "False" => Some(Literal::Bool(false)),
                word => number(word),
            },
        })
    }

    /// Parses a list or tuple from its opening bracket to its closing bracket `close`, and returns its elements.
    /// `depth` is the nesting depth of the list.
    fn sequence(&mut self, close: &str, depth: usize) -> Parsed<Vec<Literal>> {
        self.at += 1;
        let mut items = Vec::new();
        while !self.take_token(close) {
            items.push(self.value(depth + 1)?);
            if !self.take_token(",") && !self.rest().starts_with(close) {
                return Err(self.error("`,` or the closing bracket"));
            }
        }
        Ok(items)
    }

    /// Parses a dictionary from its opening to its closing brace; returns `None` for a set, which is not supported.
    /// `depth` is the nesting depth of the dictionary.
    fn dict(&mut self, depth: usize) -> Parsed<Option<Literal>> {
        self.at += 1;
        let mut entries = Vec::new();
        while !self.take_token("}") {
            let key = self.value(depth + 1)?;
            if !self.take_token(":") {
                return if matches!(self.rest().chars().next(), Some(',' | '}')) {
                    Ok(None)
                } else {
                    Err(self.error("`:`"))
                };
            }
            entries.push((key, self.value(depth + 1)?));
            if !self.take_token(",") && !self.rest().starts_with('}') {
                return Err(self.error("`,` or `}`"));
            }
        }
        Ok(Some(Literal::Dict(entries)))
    }

    /// Parses a string and replaces its escape sequences.
    fn string(&mut self) -> Parsed<String> {
        let open = self.at;
        let unterminated = ParseError { byte: open, expected: "a string with a closing quote" };
        let mut chars = self.rest().char_indices();
        let Some((_, quote)) = chars.next() else { return Err(unterminated) };
        let mut value = String::new();
        while let Some((i, c)) = chars.next() {
            if c == quote {
                self.at = open + i + 1;
                return Ok(value);
            }
            if c != '\\' {
                value.push(c);
                continue;
            }
            let bad = ParseError { byte: open + i, expected: "a Python escape sequence" };
            let Some((_, letter)) = chars.next() else { return Err(unterminated) };
            if let Some((_, meaning)) = ESCAPES.iter().find(|(known, _)| *known == letter) {
                value.push(*meaning);
                continue;
            }
            let digits = match letter {
                'x' => 2,
                'u' => 4,
                'U' => 8,
                // Keep unknown escape sequences unchanged, as Python does.
                _ => {
                    value.extend(['\\', letter]);
                    continue;
                }
            };
            let mut code = 0u32;
            for _ in 0..digits {
                let digit = chars.next().and_then(|(_, c)| c.to_digit(16));
                let Some(digit) = digit else { return Err(bad) };
                code = code << 4 | digit;
            }
            // A lone surrogate, as Python writes for a path that is not UTF-8, cannot be a char.
            value.push(char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER));
        }
        Err(unterminated)
    }

    /// Skips text that is not a Python literal. Fails if brackets do not match. Stops before one of these characters:
    ///
    /// - a comma, colon or equals sign that is not in brackets within the skipped text
    /// - a closing bracket that was opened before the skipped text
    fn skip_balanced(&mut self) -> Parsed<()> {
        let mut open = Vec::new();
        while let Some(c) = self.rest().chars().next() {
            match c {
                '\'' | '"' => {
                    self.string()?;
                    continue;
                }
                '(' => open.push(')'),
                '[' => open.push(']'),
                '{' => open.push('}'),
                ')' | ']' | '}' => match open.pop() {
                    None => return Ok(()),
                    Some(close) if close == c => {}
                    Some(_) => return Err(self.error("brackets that match")),
                },
                // Stop at `=`: after a missing comma it belongs to the next key, and skipping it would lose this key.
                ',' | ':' | '=' if open.is_empty() => return Ok(()),
                _ => {}
            }
            self.at += c.len_utf8();
        }
        if open.is_empty() { Ok(()) } else { Err(self.error("a closing bracket")) }
    }
}

/// Parses an integer or a float as Python prints it; returns `None` for other words. An integer that does not fit into
/// i64 becomes a float.
fn number(word: &str) -> Option<Literal> {
    let digits = word.trim_start_matches(['+', '-']);
    if matches!(digits, "inf" | "nan") {
        return word.parse().ok().map(Literal::Float);
    }
    if !digits.starts_with(|c: char| c.is_ascii_digit() || c == '.') {
        return None;
    }
    word.parse().map(Literal::Int).or_else(|_| word.parse().map(Literal::Float)).ok()
}
