/* The least a fan-out can cost: read a message from one TCP connection, send it as a websocket frame to all others.
 *
 *   fanout            prints "READY <port of the source> <port of the receivers>", ends with the standard input
 *
 * The source sends u32 big-endian length, then the message. A receiver sends an HTTP request and is answered 101;
 * whatever it sends later is read and dropped. One frame is built for each message and sent to all: nothing is
 * checked, nobody is judged, who is slow loses bytes. The processor time of this is what fan-out is compared with.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

#define MOST 4096
#define LARGEST (1 << 20)

static const char ANSWER[] =
    "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Accept: none\r\n\r\n";

static int receivers[MOST];
static int receiver_count;
static unsigned char input[LARGEST + 4];
static size_t have;
static unsigned char frame[LARGEST + 10];

static void die(const char *what) {
    perror(what);
    exit(1);
}

static int listening(int *port) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, sizeof address) || listen(fd, 1024)) die("listen");
    if (getsockname(fd, (struct sockaddr *)&address, &size)) die("getsockname");
    *port = ntohs(address.sin_port);
    return fd;
}

static int accepted(int listener) {
    int one = 1, fd = accept4(listener, NULL, NULL, SOCK_CLOEXEC);
    if (fd < 0) die("accept");
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    return fd;
}

static void watch(int poll, int fd) {
    struct epoll_event event = {.events = EPOLLIN, .data.fd = fd};
    if (epoll_ctl(poll, EPOLL_CTL_ADD, fd, &event)) die("epoll_ctl");
}

static void welcome(int fd) {
    char request[8192];
    size_t got = 0;
    while (got < sizeof request - 1) {
        ssize_t n = recv(fd, request + got, sizeof request - 1 - got, 0);
        if (n <= 0) die("handshake");
        got += n;
        request[got] = 0;
        if (strstr(request, "\r\n\r\n")) break;
    }
    if (send(fd, ANSWER, sizeof ANSWER - 1, MSG_NOSIGNAL) < 0) die("answer");
    fcntl(fd, F_SETFL, O_NONBLOCK);
}

static size_t build(const unsigned char *message, uint32_t length) {
    size_t head = 2;
    frame[0] = 0x81;
    if (length < 126) {
        frame[1] = length;
    } else if (length < 65536) {
        frame[1] = 126;
        frame[2] = length >> 8;
        frame[3] = length;
        head = 4;
    } else {
        frame[1] = 127;
        memset(frame + 2, 0, 4);
        for (int i = 0; i < 4; i++) frame[6 + i] = length >> (24 - 8 * i);
        head = 10;
    }
    memcpy(frame + head, message, length);
    return head + length;
}

static int spread(int source) {
    ssize_t n = recv(source, input + have, sizeof input - have, 0);
    if (n <= 0) return 0;
    have += n;
    size_t start = 0;
    while (have - start >= 4) {
        uint32_t length = (uint32_t)input[start] << 24 | input[start + 1] << 16 | input[start + 2] << 8 | input[start + 3];
        if (length > LARGEST) exit(1);
        if (have - start - 4 < length) break;
        size_t size = build(input + start + 4, length);
        for (int i = 0; i < receiver_count; i++) (void)!send(receivers[i], frame, size, MSG_NOSIGNAL);
        start += 4 + length;
    }
    memmove(input, input + start, have - start);
    have -= start;
    return 1;
}

int main(void) {
    int source_port, receiver_port, source = -1;
    int for_source = listening(&source_port), for_receivers = listening(&receiver_port);
    int poll = epoll_create1(EPOLL_CLOEXEC);
    struct epoll_event events[256];
    char dropped[65536];
    watch(poll, for_source);
    watch(poll, for_receivers);
    watch(poll, STDIN_FILENO);
    printf("READY %d %d\n", source_port, receiver_port);
    fflush(stdout);
    for (;;) {
        int n = epoll_wait(poll, events, 256, -1);
        if (n < 0 && errno != EINTR) die("epoll_wait");
        for (int i = 0; i < n; i++) {
            int fd = events[i].data.fd;
            if (fd == STDIN_FILENO) {
                return 0;
            } else if (fd == for_source) {
                source = accepted(for_source);
                watch(poll, source);
            } else if (fd == for_receivers) {
                int receiver = accepted(for_receivers);
                if (receiver_count == MOST) return 1;
                welcome(receiver);
                receivers[receiver_count++] = receiver;
                watch(poll, receiver);
            } else if (fd == source) {
                if (!spread(source)) return 0;
            } else if (recv(fd, dropped, sizeof dropped, 0) == 0) {
                epoll_ctl(poll, EPOLL_CTL_DEL, fd, NULL);
            }
        }
    }
}
