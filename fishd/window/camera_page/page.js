// Shows the pictures and texts that come over the WebSocket.
"use strict";

const AGAIN = 1000;   // after a lost connection [ms]
const picture = document.getElementById("picture");
const facts = document.getElementById("facts");

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      facts.textContent = data;
      return;
    }
    URL.revokeObjectURL(picture.src);
    picture.src = URL.createObjectURL(data);
  };
  socket.onclose = () => {
    facts.textContent = "the page's server does not answer; it is tried again";
    setTimeout(connect, AGAIN);
  };
}

connect();
