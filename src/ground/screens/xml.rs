//! Elements to XML text: escaped, and without the characters that XML 1.0 can't hold.

use std::fmt::{self, Display, Formatter, Write as _};

/// One element with its attributes and what stands in it, in the order in which they were added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Element {
    name: &'static str,
    attributes: Vec<(&'static str, String)>,
    content: Vec<Node>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Node {
    Element(Element),
    Text(String),
}

impl Element {
    pub(super) fn new(name: &'static str) -> Self {
        Self {
            name,
            attributes: Vec::new(),
            content: Vec::new(),
        }
    }

    /// An element that holds only text.
    pub(super) fn leaf(name: &'static str, text: impl Display) -> Self {
        let mut leaf = Self::new(name);
        leaf.content.push(Node::Text(text.to_string()));
        leaf
    }

    pub(super) fn with(mut self, name: &'static str, value: impl Display) -> Self {
        self.attributes.push((name, value.to_string()));
        self
    }

    pub(super) fn child(mut self, child: Self) -> Self {
        self.content.push(Node::Element(child));
        self
    }

    /// Adds all; an `Option` is none or one.
    pub(super) fn children(mut self, children: impl IntoIterator<Item = Self>) -> Self {
        self.content.extend(children.into_iter().map(Node::Element));
        self
    }

    /// Adds an element that holds only text.
    pub(super) fn field(self, name: &'static str, text: impl Display) -> Self {
        self.child(Self::leaf(name, text))
    }

    /// The whole document, with its declaration.
    pub(super) fn document(&self) -> String {
        format!("<?xml version=\"1.0\" encoding=\"UTF-8\" standalone=\"yes\"?>\n{self}")
    }
}

impl Display for Element {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "<{}", self.name)?;
        for (name, value) in &self.attributes {
            write!(f, " {name}=\"")?;
            escape(value, f)?;
            f.write_char('"')?;
        }
        if self.content.is_empty() {
            return f.write_str("/>");
        }
        f.write_char('>')?;
        for node in &self.content {
            match node {
                Node::Element(element) => element.fmt(f)?,
                Node::Text(text) => escape(text, f)?,
            }
        }
        write!(f, "</{}>", self.name)
    }
}

fn escape(text: &str, f: &mut Formatter<'_>) -> fmt::Result {
    for character in text.chars() {
        match character {
            '&' => f.write_str("&amp;")?,
            '<' => f.write_str("&lt;")?,
            '>' => f.write_str("&gt;")?,
            '"' => f.write_str("&quot;")?,
            '\t' | '\n' | '\r' => f.write_str(" ")?,
            other if is_allowed(other) => f.write_char(other)?,
            _ => f.write_char('\u{fffd}')?,
        }
    }
    Ok(())
}

/// XML 1.0, section 2.2: no control characters, no U+FFFE, no U+FFFF (surrogates are no `char`).
fn is_allowed(character: char) -> bool {
    !matches!(character, '\0'..='\u{1f}' | '\u{fffe}' | '\u{ffff}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_an_aircraft_calls_itself_can_not_break_out() {
        let name = "a\"><evil/>&\u{1}\u{ffff}";
        let element = Element::new("craft")
            .with("name", name)
            .child(Element::leaf("name", name));
        assert_eq!(
            element.to_string(),
            "<craft name=\"a&quot;&gt;&lt;evil/&gt;&amp;\u{fffd}\u{fffd}\">\
             <name>a&quot;&gt;&lt;evil/&gt;&amp;\u{fffd}\u{fffd}</name></craft>"
        );
    }
}
